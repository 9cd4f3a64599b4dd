"""Real processes that are killed, signalled, or cut off from their terminal."""

import random
import shutil
import signal
import subprocess
import sys
import time

import pytest

from dgae_jax.run import metrics
from tests.helpers import ROOT, TINY
from tests.runs import last, timeless

QUIET = {"cwd": ROOT, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


def command(*flags):
    return [sys.executable, "-u", "experiments/train.py", *map(str, flags)]


def start(run_dir):
    """Start or resume a run of 40 iterations with a checkpoint after each fifth."""
    flags = ["--run-dir", run_dir, "--total-steps", 40 * 64, "--checkpoint-every", 5 * 64]
    words = command("--resume-or-start", *flags, "--episodes", 1, *TINY)
    return subprocess.Popen(words, **QUIET)


@pytest.mark.slow
def test_kills_at_random_moments_lose_nothing(tmp_path):
    whole, killed, chance = tmp_path / "whole", tmp_path / "killed", random.Random(0)
    assert start(whole).wait() == 0
    since = time.monotonic()
    assert start(tmp_path / "again").wait() == 0  # with the compiled programs of the first
    usual = time.monotonic() - since
    kills = 0
    while kills < 25:
        process = start(killed)
        time.sleep(chance.uniform(0.3, 1.05) * usual)
        if process.poll() is None:
            process.kill()
            kills += 1
        process.wait()
        if (killed / "evaluation.json").exists():  # it got through: the next begins again
            assert last(killed).read_bytes() == last(whole).read_bytes()
            shutil.rmtree(killed)
    assert start(killed).wait() == 0
    assert last(killed).read_bytes() == last(whole).read_bytes()
    assert timeless(killed) == timeless(whole)


KINDS = [
    (signal.SIGTERM, 143),
    pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
    pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "code"), KINDS)
def test_signal_saves_and_a_second_one_ends_at_once(kind, code, tmp_path):
    run_dir = tmp_path / "run"
    rows = run_dir / "metrics.jsonl"
    flags = ["--run-dir", run_dir, "--total-steps", 10**8, "--physics", "native", "--episodes", 1]
    for signals, words in ((1, command(*flags)), (2, command("--resume", run_dir))):
        process = subprocess.Popen(words, cwd=ROOT, text=True, stdout=subprocess.PIPE)
        before = len(metrics.read(rows)) if signals == 2 else 0
        while not rows.exists() or len(metrics.read(rows)) <= before:
            time.sleep(0.2)
            assert process.poll() is None
        process.send_signal(kind)
        since = time.monotonic()
        if signals == 2:
            time.sleep(0.05)
            process.send_signal(kind)
        out, _ = process.communicate(timeout=60)
        assert time.monotonic() - since < 30
        # a second SIGHUP does not end it: a terminal that closes may send several
        second = signals == 2 and kind != signal.SIGHUP
        assert process.returncode in ((code, -kind) if second else (code,))
        if signals == 1:
            assert f"continue with --resume {run_dir}" in out
    assert last(run_dir).name.startswith("steps_")


@pytest.mark.parametrize(("kind", "code"), KINDS)
def test_signal_breaks_off_compilation(kind, code, tmp_path):
    layers = ["8"] * 32  # half a minute of compilation
    run_dir, hidden = tmp_path / "run", ["--policy.hidden", *layers, "--critic.hidden", *layers]
    words = command("--run-dir", run_dir, "--total-steps", 640, *TINY, *hidden)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(words, cwd=ROOT, **pipes)
    for line in process.stdout:
        if line.startswith("compiling, "):
            break
    process.send_signal(kind)
    out, err = process.communicate()
    said = f"stopped by {kind.name}; continue with --resume {run_dir}\n"
    assert (process.returncode, out, err) == (code, said, "")
    assert (run_dir / "metrics.jsonl").read_bytes() == b""


def test_nohup_run_survives_its_terminal(tmp_path):
    flags = ["--run-dir", tmp_path / "run", "--total-steps", 128, "--episodes", 1, *TINY]
    how = {"cwd": ROOT, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    process = subprocess.Popen(["nohup", *command(*flags)], **how)
    assert process.stdout.readline()
    process.send_signal(signal.SIGHUP)
    out, _ = process.communicate()
    assert process.returncode == 0, out


@pytest.mark.slow
@pytest.mark.parametrize("name", ["config.json", "checkpoints", "evaluations.jsonl"])
def test_kill_as_a_file_appears_can_start_or_resume(name, tmp_path):
    run_dir = tmp_path / "run"
    process = start(run_dir)
    while not (run_dir / name).exists():
        assert process.poll() is None
    process.kill()
    process.wait()
    assert start(run_dir).wait() == 0
    assert (run_dir / "evaluation.json").exists()
