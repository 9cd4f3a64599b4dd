"""Flags: how they are parsed, refused, explained and completed."""

import os
import pty
import re
import shlex
import shutil
import subprocess
import sys

import pytest

from dgae_jax.cli import parse, reproduce, train, tune
from dgae_jax.cli.main import COMMANDS, command
from dgae_jax.cli.train import parsed
from dgae_jax.configs.presets import preset
from dgae_jax.configs.resolved import resolve
from tests.helpers import ROOT


def one_line(text):
    """The words in tyro's boxes, without the frames."""
    return " ".join(re.sub(r"[╭╮╰╯│─]|^[|+]|[|+]$|-{3,}", " ", text, flags=re.M).split())


def test_flags_start_from_the_preset_of_task_and_algorithm():
    config, _ = parsed(["--env", "Ant-v5", "--algo", "DTRPO", "--gamma", "0.9"])
    expected = preset("tuned", "dtrpo", "ant").replace(gamma=0.9, env_version="v5")
    assert config == resolve(expected)
    assert parsed(["--preset", "paper"])[0] == resolve(preset("paper", "dppo", "hopper"))


@pytest.mark.parametrize(
    ("words", "setting", "value"),
    [
        ("--total_timesteps=2.5E5", "total_steps", 250_000),
        ("--n_envs 32", "num_envs", 32),
        ("--horizon 64", "num_steps", 64),
        ("--lam 0.5", "gae_lambda", 0.5),
        ("--discounting 0.5", "gamma", 0.5),
        ("--policy.clip 0.3", "policy.options", {"clip_eps": 0.3}),
        ("--algo trpo --target-kl 0.02", "policy.options", {"max_kl": 0.02}),
        ("--algo trpo --policy.backtracks 3", "policy.options", {"max_backtracks": 3}),
        ("--lr 1e-3", "policy.options", {"learning_rate": 1e-3}),
        ("--lr 1e-3", "critic.fit", {"learning_rate": 1e-3}),
        ("--lr 1e-3 --policy.learning-rate 1e-4", "policy.options", {"learning_rate": 1e-4}),
        ("--algo trpo --update-epochs 3", "critic.fit", {"epochs": 3}),
        ("--hidden-sizes 8 16", "policy.hidden", (8, 16)),
        ("--env Walker2d", "env", "walker2d"),
    ],
)
def test_names_and_numbers_of_other_trainers_are_understood(words, setting, value):
    found = parsed(words.split())[0].get(setting)
    if isinstance(value, dict):
        assert value.items() <= dict(found).items()
    else:
        assert found == value


def test_no_alias_means_two_settings():
    aliases = " ".join(parse.ALIASES.values()).split()
    assert len(set(aliases)) == len(aliases)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train --env hoper", "error: --env hoper: must be one of ant, hopper, swimmer, walker2d"),
        ("train --policy.minibatches 7", "--policy.minibatches 7: must be a divisor of"),
        ("train --inexact", "--inexact True: must be left out without --resume"),
        ("train --algo trpo --clip-eps 0.3", "--policy.clip-eps 0.3: must be unset"),
        ("train --env Hopper-v4 --env-version v5", "--env-version v5: must be v4"),
        ("train --log visdom", "--log visdom: must be one or more of tensorboard, wandb, mlflow"),
        ("train --run-dir /dev/null/x", "--run-dir /dev/null/x: must be a directory that can be"),
        ("train --num-envs many", "many: must be a whole number"),
        ("train --seed 1e400", "1e400: must be a whole number"),
        ("train --algo pop", "invalid choice 'pop'"),
        ("train --nun-envs 3", "Perhaps you meant: --n-envs, --num-envs INT"),
        ("train --env", "Missing value for argument"),
        ("train hopper", "Unrecognized options: hopper"),
        ("train --tyro-print-completion csh", "error: Shell should be one"),
        ("evaluate", "RUN-DIR Directory of the run"),
        ("evaluate nowhere", "nowhere: must be a run directory; there is nothing of that name"),
        ("calibrate", "error: RUN_DIRS: must be one run directory or more"),
        ("refit . --num-envs 0", "--num-envs 0: must be a whole number from 1 to 10,000"),
        ("render . --width 161", "--width 161: must be an even number"),
        ("export . --to npz pdf", "invalid choice 'pdf'"),
        ("reproduce x --sedes 1", "Perhaps you meant: --seeds"),
        ("reproduce x --seeds 0 -1", "--seeds 0 -1: must be whole numbers from 0 to"),
        ("reproduce x --env ant", "--env: must be left out: the sweep has many runs"),
        ("reproduce x --envs Ant-v4", "--envs Ant-v4: must be in lower case"),
        ("reproduce x --scale 1e-4", "--scale 0.0001: must be enough for one iteration"),
        ("reproduce x --variants risk --lam 0", "--gae-lambda: must be left out with --variants"),
        ("tune --seed 1", "--seed: must be left out: --tuning-seeds says how many"),
        ("tune --trials 0", "--trials 0: must be a whole number from 1 to 100,000"),
        ("tune --storage mysql://me:secret@x/y", "--storage mysql://…: must be postgresql://"),
        ("--completion csh", "--completion csh: must be one of bash, zsh, fish"),
        ("trian", "Available subcommands: train, evaluate"),
    ],
)
def test_mistakes_are_refused_with_the_flag_and_what_is_allowed(
    line, message, dgae, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    code, out, err = dgae(*line.split())
    assert (code, out) == (2, "")
    assert message in one_line(err)
    assert err.startswith("error: ") == (err.count("\n") == 1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("--resume RUN --preset paper", "--preset paper: must be left out: all settings start"),
        ("--config FILE --algo ppo", "--algo ppo: must be dppo as in FILE, or left out"),
        ("--resume RUN --run-dir x", "--run-dir x: must be left out: --resume writes to RUN"),
        ("--resume RUN --gamma 0.5", "--gamma 0.5: must be 0.995 as in RUN, or left out"),
        ("--run-dir RUN", "--run-dir RUN: must be a new or empty directory"),
    ],
)
def test_flags_that_contradict_a_run_are_refused(argv, message, trained, dgae):
    places = {"RUN": str(trained[0]), "FILE": str(trained[0] / "config.json")}
    words = [places.get(word, word) for word in argv.split()]
    code, out, err = dgae("train", *words, "--cache-dir", "none")
    for name, place in sorted(places.items()):  # FILE first, which begins like RUN
        err = err.replace(place, name)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {message}")


def test_mistakes_help_and_versions_import_no_jax():
    code = """
import sys
from dgae_jax.cli.main import main
lines = [["train", "--gamma", "1.5"], ["--version"], *([name, "--help"] for name in sys.argv[1:])]
for argv in lines:
    sys.argv = ["dgae", *argv]
    try:
        main()
    except SystemExit:
        pass
    heavy = ("jax", "mujoco", "brax", "flax", "gymnasium", "matplotlib", "optuna")
    assert not set(heavy) & set(sys.modules), (argv, set(heavy) & set(sys.modules))
"""
    done = subprocess.run(
        [sys.executable, "-c", code, *COMMANDS], cwd=ROOT, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (
        0,
        "error: --gamma 1.5: must be a number from 0 to 1\n",
    )
    assert re.search(r"^dgae_jax [\d.]+\nPython [\d.]+, jax [\d.]+, mujoco", done.stdout, re.M)


def test_help_shows_the_defaults_of_the_algorithm(dgae):
    code, out, err = dgae("train", "--algo", "trpo", "--help")
    assert (code, err) == (0, "")
    assert "summed over action dimensions [nats]. (default: 0.03)" in one_line(out)
    assert "never exceeded [environment steps]. (default: 1_000_000)" in one_line(out)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_explains_every_flag(name, dgae):
    code, out, err = dgae(name, "--help")
    assert (code, err) == (0, "")
    assert not re.search(r"(FLOAT|INT|STR|PATH|\]\]|\}) \((default|required)", one_line(out))


def test_help_names_every_command_and_flags_of_train(dgae):
    for argv in ([], ["--help"]):
        code, out, _ = dgae(*argv)
        assert code == 0
        assert all(re.search(rf"• {name}\b", out) for name in COMMANDS)
    for name in ("reproduce", "tune"):
        assert "--policy.clip-eps" in dgae(name, "--help")[1]


EXAMPLES = [
    line.strip()
    for name in COMMANDS
    for line in re.findall(r"^ {6}(dgae .*)$", command(name).arguments.__doc__, re.MULTILINE)
]


@pytest.mark.parametrize("line", EXAMPLES)
def test_examples_of_the_help_are_valid(line, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tune, "_storage", lambda url: url)
    _, name, *argv = shlex.split(line.replace("--resume", "--run-dir"))  # there is no such run
    read = {"train": train.parsed, "tune": tune.parsed, "reproduce": reproduce.parsed}
    assert read[name](argv) if name in read else parse.arguments(command(name).arguments, argv)


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash")
def test_bash_completes_commands_flags_and_names(dgae, tmp_path):
    (tmp_path / "dgae.bash").write_text(dgae("--completion", "bash")[1])
    program = (
        'source dgae.bash; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _tyro_dgae; '
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )

    def complete(*words):
        argv = ["bash", "-c", program, "bash", "dgae", *words]
        return subprocess.check_output(argv, cwd=tmp_path, text=True).split()

    assert set(COMMANDS) <= set(complete(""))
    assert {"dppo", "dtrpo", "da2c"} <= set(complete("train", "--algo", "d"))
    assert complete("export", "x", "--to", "npz", "o") == ["onnx"]
    assert "--critic.target" in complete("tune", "--critic.ta")
    for shell in ("zsh", "fish"):
        assert all(name in dgae("--completion", shell)[1] for name in COMMANDS)


@pytest.mark.parametrize(
    ("environment", "colours"),
    [
        ({"TERM": "xterm"}, True),
        ({"TERM": "dumb"}, False),
        ({"TERM": "xterm", "NO_COLOR": "1"}, False),
    ],
)
def test_a_terminal_has_colours_where_it_can_and_may(environment, colours):
    ours, theirs = pty.openpty()
    variables = {k: v for k, v in os.environ.items() if k != "NO_COLOR"} | {"COLUMNS": "80"}
    program = [sys.executable, "-m", "dgae_jax", "figures", "--help"]
    subprocess.run(program, cwd=ROOT, stdout=theirs, env=variables | environment, check=True)
    os.close(theirs)
    assert (b"\x1b[" in os.read(ours, 100_000)) == colours
