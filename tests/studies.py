"""Small sweeps and tunings by the real commands."""

import os
import subprocess
import sys
import time

from dgae_jax.run import metrics
from tests.helpers import ROOT, TINY

SHAPE = [*TINY, "--envs", "hopper", "--algos", "ppo", "--episodes", "2"]

TIMES = ("seconds", "samples_per_second", "command")
"""Fields that differ between two sweeps of the same runs."""


def command(*words):
    """Start a Python program with its arguments."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, *map(str, words)], cwd=ROOT, text=True, **pipes)


def start(sweep, *more, steps=10, program=("experiments/reproduce.py",)):
    """Start a sweep of runs of so many iterations, with a checkpoint at half of them."""
    shape = [*SHAPE, "--total-steps", 64 * steps, "--checkpoint-every", 32 * steps]
    return command(*program, sweep, *shape, "--seeds", 0, 1, *more)


def finish(process):
    """Return the exit code, the lines and the errors of a process."""
    out, err = process.communicate(timeout=500)
    return process.returncode, out.splitlines(), err


def succeed(process):
    """Return the lines of a process that must end with exit code 0 and without errors."""
    code, lines, errors = finish(process)
    assert (code, errors) == (0, ""), lines
    return lines


def wait_for(what, seconds=240):
    """Wait until a condition holds."""
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def rows(sweep):
    """Return the results without their times."""
    found = metrics.read(sweep / "results.jsonl")
    return [{k: v for k, v in row.items() if k not in TIMES} for row in found]


def first_child():
    """Return the id of the first process that this one started and that still runs."""
    found = subprocess.run(["pgrep", "--oldest", "-P", str(os.getpid())], capture_output=True)
    return int(found.stdout)
