"""Real processes that are killed, signalled, or cut off from their terminal."""

import random
import shutil
import subprocess
import sys
import time

import pytest

from tests.helpers import ROOT, TINY
from tests.runs import assert_same, each_signal, last

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
    assert_same(killed, whole)


@each_signal
def test_signal_breaks_off_compilation(kind, code, tmp_path):
    layers = ["8"] * 16  # several seconds of compilation
    run_dir, hidden = tmp_path / "run", ["--policy.hidden", *layers, "--critic.hidden", *layers]
    words = command("--run-dir", run_dir, "--total-steps", 640, *TINY, *hidden)
    process = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline().startswith("hopper-v4")
    process.send_signal(kind)
    out, _ = process.communicate()
    said = f"stopped by {kind.name}; continue with --resume {run_dir}\n"
    assert (process.returncode, out) == (code, said)
    assert (run_dir / "metrics.jsonl").read_bytes() == b""
