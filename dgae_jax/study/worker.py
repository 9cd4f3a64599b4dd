"""The process of one run of a sweep: python -m dgae_jax.study.worker SWEEP NAME OPTIONS [CORE …]

It ends with the exit code of the run. It stops, with a checkpoint, when its standard input ends,
because then the process that started it is gone.
"""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import terminal
from dgae_jax.run.directory import InUseError
from dgae_jax.run.options import RunOptions
from dgae_jax.study import sweep as sweeps
from dgae_jax.study.sweep import RunSpec, Sweep

IN_USE_TIMEOUT = 300.0
"""Longest wait for another process of the same run, which is about to stop [s]."""


class Job(NamedTuple):
    """A run of a sweep and how to train it."""

    sweep: Sweep
    run: RunSpec
    options: RunOptions


def execute(job: Job, cores: Sequence[int] = (), lifeline: int = subprocess.PIPE) -> int:
    """Train a run in a process of its own, on some cores, and return its exit code.

    The run stops when the other end of `lifeline`, the standard input of the process, is closed.
    """
    options = json.dumps(dataclasses.asdict(job.options))
    words = [str(job.sweep.path.absolute()), job.run.name, options, *map(str, cores)]
    with job.sweep.log(job.run).open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", __name__, *words],
            stdin=lifeline,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C reaches the launcher only, which stops its runs
        )
    with process:
        return process.wait()


def main() -> int:
    """Continue or start the run."""
    terminal.prepare()
    path, name, options, *cores = sys.argv[1:]
    if cores:
        os.sched_setaffinity(0, map(int, cores))
    threading.Thread(target=_stop_when_abandoned, daemon=True).start()
    sweep = sweeps.read(Path(path))
    run = next(each for each in sweep.runs if each.name == name)
    where = {"run_dir": sweep.run_dir(run), "resume_or_start": True, "num_processes": 1}
    return _train(run.config, RunOptions(**{**json.loads(options), **where}))


def _stop_when_abandoned() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def _train(config: ResolvedConfig, options: RunOptions) -> int:
    from dgae_jax.run import training  # after the cores are set

    deadline = time.monotonic() + IN_USE_TIMEOUT
    while True:
        try:
            return training.train_command(config, options)
        except ConfigError as mistake:
            if not isinstance(mistake, InUseError) or time.monotonic() > deadline:
                terminal.warn(f"error: {mistake}")
                return 2
            time.sleep(0.5)


if __name__ == "__main__":
    sys.exit(main())
