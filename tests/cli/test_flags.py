"""Flags: how they are parsed, refused, explained and completed."""

import os
import pty
import re
import shutil
import subprocess
import sys

import pytest

from dgae_jax.cli.main import COMMANDS
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
        ("--horizon 64", "num_steps", 64),
        ("--lam 0.5", "gae_lambda", 0.5),
        ("--policy.clip 0.3", "policy.options", {"clip_eps": 0.3}),
        ("--algo TRPO --target-kl 0.02", "policy.options", {"max_kl": 0.02}),
        ("--lr 1e-3", "policy.options", {"learning_rate": 1e-3}),
        ("--lr 1e-3 --policy.learning-rate 1e-4", "policy.options", {"learning_rate": 1e-4}),
        ("--algo Trpo --update-epochs 3", "critic.fit", {"epochs": 3}),
        ("--epochs 5 --policy.epochs 10", "policy.options", {"epochs": 10}),
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


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train --env hoper", "error: --env hoper: must be one of ant, hopper, swimmer, walker2d"),
        ("train --env Hopper-v4 --env-version v5", "--env-version v5: must be v4"),
        ("train --seed 1e400", "1e400: must be a whole number"),
        ("train --algo pop", "invalid choice 'pop'"),
        ("train --nun-envs 3", "Perhaps you meant: --n-envs, --num-envs INT"),
        ("evaluate", "RUN-DIR Directory of the run"),
        ("evaluate nowhere", "nowhere: must be a run directory (No such file"),
        ("refit . --num-envs 0", "0: must be a whole number from 1 to 10,000"),
        ("reproduce x --seeds 0 -1", "--seeds 0 -1: must be whole numbers from 0 to"),
        ("reproduce x --env hopper", "--env, --algo: a sweep has"),
        ("reproduce x --envs Ant-v4", "--envs Ant-v4: must be in lower case"),
        ("reproduce x --scale 1e-4", "--total-steps 100: must be at least one iteration"),
        ("reproduce x --variants risk --lam 0", "--gae-lambda 0.0: cannot be combined with"),
        ("reproduce x --launcher cloud", "invalid choice 'cloud'"),
        ("reproduce x --processes 0", "0: must be a whole number from 1 to 1,024"),
        ("reproduce x --launcher ray --processes 1000", "--processes 1000: must be unset"),
        ("reproduce x --launcher ray --address a", "--address a: must be auto, or HOST:PORT"),
        ("tune --seed 1", "--seed: cannot be combined with many runs"),
        ("tune --keep-checkpoints 1", "--keep-checkpoints: cannot be combined with"),
        (
            "reproduce x --variants risk --algos ppo",
            "--algos ppo: cannot be combined with --variants",
        ),
        ("tune --storage mysql://me:secret@x/y", "error: --storage: must be postgresql://"),
        ("--completion csh", "error: Shell should be one"),
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
        ("--resume RUN --preset paper", "--preset paper: cannot be combined with RUN"),
        ("--config FILE --algo ppo", "--algo ppo: must be dppo as in FILE, or left out"),
        ("--resume RUN --run-dir x", "--run-dir x: cannot be combined with --resume RUN"),
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
    mistake = "error: --gamma 1.5: must be a number from 0 to 1\n"
    assert (done.returncode, done.stderr) == (0, mistake)
    assert re.search(r"^dgae_jax [\d.]+\nPython [\d.]+, jax [\d.]+, mujoco", done.stdout, re.M)


def test_help_shows_the_defaults_of_the_algorithm(dgae):
    text = one_line(dgae("train", "--algo", "trpo", "--help")[1])
    assert "summed over action dimensions [nats]. (default: 0.03)" in text
    assert "--policy.clip-eps FLOAT PPO's clip range ε" in text
    assert "never exceeded [environment steps]. (default: 1_000_000)" in text


@pytest.mark.parametrize("name", COMMANDS)
def test_help_names_every_command_and_explains_every_flag(name, dgae):
    assert all(re.search(rf"• {name}\b", dgae(*argv)[1]) for argv in ([], ["--help"]))
    code, out, err = dgae(name, "--help")
    assert (code, err) == (0, "")
    assert not re.search(r"(FLOAT|INT|STR|PATH|\]\]|\}) \((default|required)", one_line(out))


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
    assert all(name in dgae("--completion", "zsh")[1] for name in COMMANDS)


@pytest.mark.parametrize(("environment", "colours"), [({}, True), ({"NO_COLOR": "1"}, False)])
def test_a_terminal_has_colours_where_it_can_and_may(environment, colours):
    ours, theirs = pty.openpty()
    variables = {k: v for k, v in os.environ.items() if k != "NO_COLOR"} | {"TERM": "xterm"}
    program = [sys.executable, "-m", "dgae_jax", "figures", "--help"]
    subprocess.run(program, cwd=ROOT, stdout=theirs, env=variables | environment, check=True)
    os.close(theirs)
    assert (b"\x1b[" in os.read(ours, 100_000)) == colours
