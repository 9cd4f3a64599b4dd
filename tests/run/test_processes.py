"""Real processes that are killed, signalled, or cut off from their terminal."""

import random
import shutil
import signal
import subprocess
import sys
import time

import pytest

from dgae_jax.run import checkpoint, directory, metrics
from tests.helpers import ROOT, TINY
from tests.runs import last, timeless


def start(run_dir, *more):
    """The real command on a run of 40 iterations with a checkpoint after each fifth, new or resumed."""
    if (run_dir / "config.json").exists():
        argv = ["--resume", str(run_dir)]
    else:
        argv = ["--run-dir", str(run_dir), "--total-steps", str(40 * 64), *TINY]
    argv += ["--checkpoint-every", str(5 * 64), "--episodes", "1", *more]
    return subprocess.Popen(
        [sys.executable, "experiments/train.py", *argv],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


@pytest.mark.slow
def test_twenty_five_kills_at_random_moments_lose_nothing(tmp_path):
    whole, killed, chance = tmp_path / "whole", tmp_path / "killed", random.Random(0)
    assert start(whole).wait() == 0
    since = time.monotonic()
    assert (
        start(tmp_path / "again").wait() == 0
    )  # what the others take, whose programs are kept by the first
    usual = time.monotonic() - since
    kills = 0
    while kills < 25:
        process = start(killed)
        time.sleep(chance.uniform(0.3, 1.05) * usual)
        if process.poll() is None:
            process.kill()
            kills += 1
        process.wait()
        if (
            killed / "evaluation.json"
        ).exists():  # it got through: the next kills meet a run that begins again
            assert last(killed).read_bytes() == last(whole).read_bytes()
            shutil.rmtree(killed)
    assert start(killed).wait() == 0
    assert last(killed).read_bytes() == last(whole).read_bytes()
    assert timeless(killed) == timeless(whole)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGHUP, 129)]
)
def test_a_signal_saves_within_half_a_minute_and_a_second_one_ends_at_once(kind, code, tmp_path):
    run_dir = tmp_path / "run"
    argv = [
        "--run-dir",
        str(run_dir),
        "--total-steps",
        "100_000_000",
        "--physics",
        "native",
        "--episodes",
        "1",
    ]
    for signals in (1, 2):
        process = subprocess.Popen(
            [sys.executable, "experiments/train.py", *(argv if signals == 1 else ["--resume", str(run_dir)])], cwd=ROOT, text=True,
            stdout=subprocess.PIPE,
        )  # fmt: skip
        lines = len(metrics.read(run_dir / "metrics.jsonl")) if signals == 2 else 0
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and not (
            (run_dir / "metrics.jsonl").exists()
            and len((run_dir / "metrics.jsonl").read_text().splitlines()) > lines
        ):
            time.sleep(0.2)
        process.send_signal(kind)
        since = time.monotonic()
        if signals == 2:
            time.sleep(0.05)
            process.send_signal(kind)
        out, _ = process.communicate(timeout=60)
        assert time.monotonic() - since < 30
        # a second SIGHUP does not end it: a terminal that closes may send several
        assert process.returncode in (
            (code,) if signals == 1 or kind == signal.SIGHUP else (code, -kind)
        )
        if signals == 1:
            assert f"continue with --resume {run_dir}" in out
    state, _ = checkpoint.latest_train_state(run_dir, directory.read_config(run_dir))
    assert int(state.iteration[0]) >= 1


@pytest.mark.parametrize(
    ("kind", "code"),
    [
        (signal.SIGTERM, 143),
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow),
    ],
)
def test_a_signal_while_it_compiles_ends_it_at_once(kind, code, tmp_path):
    layers = ["8"] * 32  # half a minute of compilation
    argv = [
        "--run-dir",
        str(tmp_path / "run"),
        "--total-steps",
        "640",
        *TINY,
        "--policy.hidden",
        *layers,
        "--critic.hidden",
        *layers,
    ]
    command = [sys.executable, "-u", "experiments/train.py", *argv]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    for line in process.stdout:
        if line.startswith("compiling, "):
            break
    process.send_signal(kind)
    out, err = process.communicate()
    assert (process.returncode, out, err) == (
        code,
        f"stopped by {kind.name}; continue with --resume {tmp_path / 'run'}\n",
        "",
    )
    assert (tmp_path / "run" / "metrics.jsonl").read_bytes() == b""


def test_a_run_under_nohup_stays_when_its_terminal_goes(tmp_path):
    argv = ["--run-dir", str(tmp_path / "run"), "--total-steps", "640", "--episodes", "1", *TINY]
    command = ["nohup", sys.executable, "experiments/train.py", *argv]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout.readline()
    process.send_signal(signal.SIGHUP)
    out, _ = process.communicate()
    assert process.returncode == 0, out


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["config.json", "checkpoints", "metrics.jsonl", "evaluations.jsonl"]
)
def test_a_kill_at_the_moment_a_file_appears_leaves_what_can_be_started_or_resumed(name, tmp_path):
    run_dir = tmp_path / "run"
    argv = [
        "--resume-or-start",
        "--run-dir",
        str(run_dir),
        "--total-steps",
        "640",
        "--episodes",
        "1",
        *TINY,
    ]
    command = [sys.executable, "experiments/train.py", *argv]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    while not (run_dir / name).exists():
        assert process.poll() is None
    process.kill()
    process.wait()
    assert subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL).returncode == 0
    assert (run_dir / "evaluation.json").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
