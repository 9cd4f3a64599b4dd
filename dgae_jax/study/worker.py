"""Processes of sweeps and tunings: python -m dgae_jax.study.worker NAME WORK [CORE …]

A process ends with the exit code of its work. It gets SIGTERM when its standard input ends, because
then the process that started it is gone or wants it to stop.
"""

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import terminal
from dgae_jax.run.directory import InUseError
from dgae_jax.run.options import RunOptions

IN_USE_TIMEOUT = 300.0
"""Longest wait for another process of the same run, which is about to stop [s]."""


class Job(NamedTuple):
    """Work for a process of its own."""

    name: str
    work: Callable[..., int]
    """A function of a module, which returns an exit code."""
    args: tuple[Any, ...]
    log: Path
    """File to which the output is appended."""


def execute(job: Job, cores: Sequence[int] = (), lifeline: int = subprocess.PIPE) -> int:
    """Run a job in a process of its own, on some cores, and return its exit code.

    The job stops when the other end of `lifeline`, the standard input of the process, is closed.
    """
    packed = pickle.dumps((job.work, job.args)).hex()
    with job.log.open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", __name__, job.name, packed, *map(str, cores)],
            stdin=lifeline,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C reaches the launcher only, which stops its jobs
        )
    with process:
        return process.wait()


def train_run(config: ResolvedConfig, options: RunOptions) -> int:
    """Continue or start the run of a sweep, and return its exit code."""
    from dgae_jax.run import training  # imports JAX, after the cores are set

    deadline = time.monotonic() + IN_USE_TIMEOUT
    while True:
        try:
            return training.train_command(config, options)
        except InUseError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)


def _stop_when_abandoned() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    terminal.prepare()
    if cores := sys.argv[3:]:
        os.sched_setaffinity(0, map(int, cores))
    threading.Thread(target=_stop_when_abandoned, daemon=True).start()
    work, args = pickle.loads(bytes.fromhex(sys.argv[2]))
    try:
        code = work(*args)
    except ConfigError as mistake:
        terminal.warn(f"error: {mistake}")
        code = 2
    sys.stdout.flush()
    os._exit(code)  # without waiting for a compiler that was broken off
