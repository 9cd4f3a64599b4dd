"""The commands as a user meets them."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest

from dgae_jax.cli import arguments
from dgae_jax.cli.main import COMMANDS
from dgae_jax.cli.train import parsed
from dgae_jax.run import directory, metrics, runtime
from dgae_jax.run.options import METRIC_LOGGERS
from tests.helpers import ROOT, TINY, command


@pytest.fixture
def run(monkeypatch, capsys):
    def run(name, *argv):
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, argv)])
        try:
            code = command(name)()
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A finished tiny run: its directory and what it printed."""
    directory = tmp_path_factory.mktemp("runs") / "tiny"
    argv = [
        "--total-steps",
        "1000",
        "--run-dir",
        str(directory),
        "--episodes",
        "3",
        "--checkpoint-every",
        "300",
        *TINY,
    ]
    done = subprocess.run(
        [sys.executable, "experiments/train.py", *argv],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    return directory, done.stdout.splitlines(), done.stderr


def test_training_writes_a_whole_run_directory(trained):
    directory, _, _ = trained
    assert {p.name for p in directory.iterdir()} == {
        "config.json", "manifest.json", "metrics.jsonl", "evaluations.jsonl", "checkpoints", "curve.png", "evaluation.json",
    }  # fmt: skip
    assert (directory / "curve.png").read_bytes().startswith(b"\x89PNG")
    config = json.loads((directory / "config.json").read_text())
    assert config["critic"]["target"] == "sr-lambda"


def test_the_budget_is_never_exceeded_and_the_first_line_says_how_much_is_used(trained):
    directory, lines, _ = trained
    assert lines[0] == "hopper-v4 dppo on native: 15 iterations × 64 samples = 960 of 1,000 steps"
    rows = metrics.read(directory / "metrics.jsonl")
    assert [row["steps"] for row in rows] == list(range(64, 961, 64))
    assert all("episode_return" in row for row in rows)


def test_progress_is_plain_lines_when_piped(trained):
    _, lines, errors = trained
    assert re.search(r"^960 of 960 steps  [\d,]+ steps/s  return [\d.,]+  0:00:00 left$", lines[-3])
    assert lines[-2] == "evaluating 3 episodes in Hopper-v4 (gymnasium)"
    assert "\x1b" not in "".join(lines)
    assert errors == ""


def test_the_last_line_is_the_return_in_gymnasium_and_where_the_files_are(trained):
    directory, lines, _ = trained
    result = json.loads((directory / "evaluation.json").read_text())
    assert result["engine"] == "gymnasium"
    assert result["episodes"] == len(result["returns"]) == 3
    mean, std = f"{result['return_mean']:,.1f}", f"{result['return_std']:,.1f}"
    assert lines[-1] == (
        f"return {mean} ± {std} over 3 episodes of the deterministic policy in Hopper-v4 (gymnasium); files in {directory}"
    )


def test_checkpoints_are_saved_and_evaluated_along_the_way_and_at_the_end(trained):
    directory, _, _ = trained
    evaluations = metrics.read(directory / "evaluations.jsonl")
    assert [row["steps"] for row in evaluations] == [256, 512, 768, 960]
    best = max(evaluations[:-1], key=lambda row: (row["return_mean"], row["steps"]))["steps"]
    kept = sorted({best, 512, 768, 960})
    assert [p.name for p in sorted((directory / "checkpoints").iterdir())] == [
        f"steps_{steps:012d}.msgpack" for steps in kept
    ]


def test_the_best_checkpoint_is_evaluated_if_asked_for(trained, run, tmp_path):
    rows = metrics.read(trained[0] / "evaluations.jsonl")
    code, _, _ = run(
        "evaluate",
        trained[0],
        "--checkpoint",
        "best",
        "--episodes",
        3,
        "--out",
        tmp_path / "best.json",
    )
    result = json.loads((tmp_path / "best.json").read_text())
    assert code == 0
    assert result["return_mean"] == pytest.approx(max(row["return_mean"] for row in rows))
    assert result["checkpoint"] in {f"steps_{row['steps']:012d}.msgpack" for row in rows}


@pytest.mark.parametrize("engine", ["gymnasium", "native"])
def test_evaluate_loads_a_run_and_writes_json(engine, trained, run):
    directory, _, _ = trained
    code, out, _ = run("evaluate", directory, "--engine", engine, "--episodes", 4)
    assert code == 0
    result = json.loads((directory / f"evaluation-{engine}.json").read_text())
    assert result["engine"] == engine
    assert len(result["returns"]) == 4
    assert (
        f"return {result['return_mean']:,.1f} ± {result['return_std']:,.1f} over 4 episodes" in out
    )


def test_evaluating_twice_gives_the_same_returns(trained, run, tmp_path):
    results = []
    for name in ("a.json", "b.json"):
        run("evaluate", trained[0], "--episodes", 3, "--out", tmp_path / name)
        results.append(json.loads((tmp_path / name).read_text())["returns"])
    assert (
        results[0]
        == results[1]
        == json.loads((trained[0] / "evaluation.json").read_text())["returns"]
    )


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--foo", "3"], r"--foo: is not a flag of this command"),
        (["--policy.clp", "3"], r"--policy.clp: is not a flag of this command; perhaps --policy.clip_eps-eps"),
        (["--num-envs", "many"], r"--num-envs many: must be a whole number"),
        (["--num-envs"], r"--num-envs"),
        (["--policy.minibatches", "7"], r"--policy.minibatches 7: must be a divisor of num_envs \* num_steps = 2,048"),
        (["--env", "hoper"], r"--env hoper: must be one of ant, hopper, swimmer, walker2d"),
        (["--run-dir", "/dev/null/below"], r"--run-dir /dev/null/below: must be a directory that can be written"),
        (["--cache-dir", "/dev/null/below"], r"--cache-dir /dev/null/below: must be a directory that can be written, or none"),
        (["--episodes", "0"], r"--episodes 0: must be a whole number from 1 to 10,000"),
        (["--checkpoint-every", "0"], r"--checkpoint-every 0: must be a whole number from 1 to"),
        (["--resume", "x" * 300], r"x+: must be a run directory, or the file of a policy \(File name too long\)"),
        (["--resume-or-start", "--run-dir", "x" * 300], r"--run-dir x+: must be a directory that can be written \(File name too long\)"),
        (["--inexact"], r"--inexact True: must be left out without --resume"),
        (["--num-envs", "1e9", "--num-steps", "1", "--policy.minibatches", "1", "--critic.minibatches", "1", "--total-steps", "1e9"],
         r"--num-envs 1000000000: must be smaller: the run needs at least [\d,.]+ GiB of memory, and there are [\d.,]+ GiB"),
        (["--policy.hidden", *["8"] * 1000], r"--policy.hidden of 1,000 layers: must be at most 32"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_on_stderr_and_exit_code_2(argv, message, run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("train", *argv)
    assert code == 2
    assert out == ""
    assert re.fullmatch(rf"error: .*{message}.*\n", err)
    assert list(tmp_path.iterdir()) == []


def test_a_used_run_directory_is_refused_and_left_alone(trained, run):
    directory, _, _ = trained
    before = (directory / "metrics.jsonl").read_bytes()
    code, _, err = run("train", "--run-dir", directory, "--cache-dir", "none")
    assert (code, err) == (2, f"error: --run-dir {directory}: must be a new or empty directory\n")
    assert (directory / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (
            ["--resume", "RUN", "--preset", "paper"],
            r"--preset paper: must be left out: all settings start from RUN",
        ),
        (
            ["--resume", "RUN", "--config", "FILE"],
            r"--config FILE: must be left out: all settings start from RUN",
        ),
        (
            ["--config", "FILE", "--algo", "ppo"],
            r"--algo ppo: must be dppo as in FILE, or left out",
        ),
        (
            ["--config", "FILE", "--preset", "paper"],
            r"--preset paper: must be left out: all settings start from FILE",
        ),
        (
            ["--resume", "RUN", "--run-dir", "there"],
            r"--run-dir there: must be left out: --resume writes to RUN",
        ),
        (
            ["--resume", "RUN", "--gamma", "0.5"],
            r"--gamma 0\.5: must be 0\.995 as in RUN, or left out",
        ),
    ],
)
def test_flags_that_would_have_no_effect_are_refused(
    argv, message, trained, run, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    places = {"RUN": str(trained[0]), "FILE": str(trained[0] / "config.json")}
    code, out, err = run("train", *(places.get(word, word) for word in argv), "--cache-dir", "none")
    for name, place in sorted(places.items()):  # FILE first, which begins like RUN
        err = err.replace(place, name)
    assert (code, out) == (2, "")
    assert re.fullmatch(rf"error: {message}\n", err)


def test_a_mistake_is_refused_before_jax_mujoco_and_brax_are_imported():
    code = """
import sys
from dgae_jax.cli.train import main
sys.argv = ["train", "--gamma", "1.5"]
try:
    main()
except SystemExit as stop:
    print(stop.code, [name for name in ("jax", "mujoco", "brax", "flax", "gymnasium", "matplotlib") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == (
        "2 []\n",
        "error: --gamma 1.5: must be a number from 0 to 1\n",
    )


def test_dgae_runs_a_command_by_name_and_names_them_all(monkeypatch, capsys):
    def dgae(*argv):
        monkeypatch.setattr(sys, "argv", ["dgae", *argv])
        try:
            code = command("main")()
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    assert dgae("evaluate", "--episodes", "0", ".")[::2] == (
        2,
        "error: --episodes 0: must be a whole number from 1 to 10,000 (they are played side by side)\n",
    )
    assert dgae("trian") == (
        2,
        "",
        f"error: trian: must be one of {', '.join(COMMANDS)}; perhaps train\n",
    )
    code, out, err = dgae("--help")
    assert (code, err) == (0, "")
    assert all(
        re.search(rf"^  {name} ", out, re.MULTILINE)
        for name in ("train", "evaluate", "render", "figures")
    )


def test_a_device_that_is_not_there_is_refused_in_one_line(tmp_path):
    done = subprocess.run(
        [sys.executable, "experiments/train.py", "--run-dir", str(tmp_path / "run")], cwd=ROOT, capture_output=True, text=True,
        env={**os.environ, "JAX_PLATFORMS": "abacus"},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(
        r"error: JAX_PLATFORMS=abacus: must name a device that JAX finds here, .*; an NVIDIA GPU needs .*\n",
        done.stderr,
    )
    assert not (tmp_path / "run").exists()


def test_a_command_that_leaves_a_compiler_to_itself_ends_before_that_aborts_it(monkeypatch, capsys):
    codes, idle = [], threading.Event()
    monkeypatch.setattr(os, "_exit", codes.append)
    assert (arguments.stopped("stopped"), codes) == (130, [])
    left = threading.Thread(target=idle.wait, name=runtime.COMPILER_THREAD, daemon=True)
    left.start()
    arguments.stopped("stopped")
    idle.set()
    left.join()  # where it still ran, the next command to be stopped would end this process
    assert codes == [130]
    assert capsys.readouterr().err == "stopped\nstopped\n"


@pytest.mark.parametrize(("name", "work"), [("train", "parsed"), ("evaluate", "parse")])
def test_an_interrupt_where_nothing_is_at_stake_ends_with_130_and_one_line(
    name, work, trained, run, monkeypatch, tmp_path
):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    main = command(name)
    monkeypatch.setitem(main.__globals__, work, interrupted)
    monkeypatch.setattr(sys.modules[__name__], "command", lambda _: main)
    code, out, err = run(
        name, *([trained[0]] if name == "evaluate" else ["--run-dir", tmp_path / "run"])
    )
    assert (code, out) == (130, "")
    assert re.fullmatch(r"stopped by SIGINT.*\n", err)


def test_a_resumed_run_starts_from_its_own_flags(trained):
    config, options = parsed(["--resume", str(trained[0]), "--episodes", "5"])
    assert config == directory.read_config(trained[0])
    assert (options.checkpoint_every, options.episodes, options.keep_checkpoints) == (300, 5, 3)


def test_viewers_are_named_behind_one_flag_and_a_missing_one_is_refused_in_one_line_that_says_what_to_install(
    run, monkeypatch, tmp_path
):
    assert parsed(["--log", "tensorboard"])[1].log == ("tensorboard",)
    assert parsed(["--log", "--env", "hopper"])[1].log == ()
    monkeypatch.setitem(METRIC_LOGGERS, "wandb", "a_library_that_nobody_has")
    code, out, err = run("train", "--log", "tensorboard", "wandb", "--run-dir", tmp_path / "run")
    assert (code, out) == (2, "")
    assert (
        err
        == 'error: --log wandb: a_library_that_nobody_has is missing; pip install "dgae_jax[wandb]"\n'
    )
    code, _, err = run("train", "--log", "visdom")
    assert (code, err) == (
        2,
        "error: --log visdom: must be one or more of tensorboard, wandb, mlflow\n",
    )
    assert not (tmp_path / "run").exists()


def test_an_output_that_is_no_file_is_left_alone(trained, run, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for name in ("pipe", "link", "."):
        code, _, err = run("evaluate", trained[0], "--out", tmp_path / name)
        assert (code, err) == (
            2,
            f"error: --out {tmp_path / name}: must be a file, not a directory, a link or a device\n",
        )
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["nowhere"], r"nowhere: must be a run directory; there is nothing of that name"),
        ([], r"RUN_DIR: must be given"),
        ([".", "--engine", "ode"], r"--engine ode: must be one of .*gymnasium"),
        ([".", "--episodes", "0"], r"--episodes 0: must be a whole number from 1 to 10,000"),
    ],
)
def test_evaluate_refuses_bad_input_in_one_line(argv, message, run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("evaluate", *argv)
    assert (code, out) == (2, "")
    assert re.fullmatch(rf"error: .*({message}).*\n", err)


def test_help_explains_every_flag(run):
    code, out, _ = run("train", "--help")
    assert code == 0
    for flag in ("--env", "--algo", "--physics", "--seed", "--num-seeds", "--total-steps", "--num-envs", "--gamma", "--gae-lambda", "--run-dir",
                 "--cache-dir", "--critic.target", "--policy.clip_eps-eps"):  # fmt: skip
        assert re.search(rf"{flag}\b", out)


@pytest.mark.parametrize(("kind", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_saves_a_checkpoint_and_ends_with_its_code(kind, code, tmp_path):
    argv = ["--total-steps", "100_000_000", "--run-dir", str(tmp_path / "run"), *TINY]
    process = subprocess.Popen(
        [sys.executable, "experiments/train.py", *argv], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    lines = tmp_path / "run" / "metrics.jsonl"
    deadline = time.monotonic() + 120
    while not (lines.exists() and lines.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.2)
    process.send_signal(kind)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == code
    assert f"stopped by {kind.name}; continue with --resume" in out
    steps = metrics.read(lines)[-1]["steps"]
    assert (tmp_path / "run" / "checkpoints" / f"steps_{steps:012d}.msgpack").exists()


def test_importing_the_package_pulls_in_no_plotting_no_gymnasium_no_web_server_and_prints_nothing():
    code = "import dgae_jax, sys; print([m for m in ('matplotlib', 'gymnasium', 'flask', 'tyro', 'IPython') if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
    assert done.stdout == "[]\n"


def test_public_names_exist_and_functions_and_classes_say_what_they_are():
    import dgae_jax

    for name in dgae_jax.__all__:
        value = getattr(dgae_jax, name)
        assert not callable(value) or value.__doc__ not in (None, type(value).__doc__), name
