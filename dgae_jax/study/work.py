"""The process of one cell: python -m dgae_jax.study.work STUDY CELL OPTIONS [CORE …]

It ends with the exit code of a run. It stops, with a checkpoint, when its standard input ends: whoever started it is gone then, and
nobody would wait for it.
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
from dgae_jax.run.options import RunOptions, read_options, saved_options
from dgae_jax.study.matrix import Cell, Study

IN_USE_SECONDS = 300.0
"""How long to wait for another process of the same cell, which is about to stop."""


class Job(NamedTuple):
    """What a launcher is given: a cell of a study, and how to train it."""

    study: Study
    cell: Cell
    options: RunOptions


def run(job: Job, cores: Sequence[int] = (), lifeline: int = subprocess.PIPE) -> int:
    """Train a cell in a process of its own, on some of the cores, and return its exit code; what it says goes to the cell's log.

    It stops when the other end of `lifeline` is closed: by default, when this process ends.
    """
    options = json.dumps(
        {
            **saved_options(job.options),
            "cache_dir": job.options.cache_dir,
            "inexact": job.options.inexact,
        }
    )
    words = [
        sys.executable,
        "-m",
        __name__,
        str(job.study.path.absolute()),
        job.cell.name,
        options,
        *map(str, cores),
    ]
    with job.study.log(job.cell).open("ab") as log:
        # a session of its own: Ctrl-C comes to whoever started it, who stops it
        process = subprocess.Popen(
            words, stdin=lifeline, stdout=log, stderr=log, start_new_session=True
        )
    with process:
        return process.wait()


def main() -> int:
    """Continue or start the run of a cell."""
    terminal.prepare()
    where, name, options, *cores = sys.argv[1:]
    if cores:
        os.sched_setaffinity(0, map(int, cores))
    threading.Thread(target=_stop_when_left, daemon=True).start()
    from dgae_jax.study import matrix

    study, chosen = matrix.read(Path(where)), json.loads(options)
    cell = next(each for each in study.cells if each.name == name)
    how = {"run_dir": study.run_dir(cell), "resume_or_start": True, "num_processes": 1}
    how |= {name: chosen[name] for name in ("cache_dir", "inexact")}
    return _train(cell.config, dataclasses.replace(read_options(chosen), **how))


def _stop_when_left() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def _train(config: ResolvedConfig, options: RunOptions) -> int:
    from dgae_jax.run import training

    since = time.monotonic()
    while True:
        try:
            return training.train_command(config, options)
        except InUseError as reason:
            if time.monotonic() - since > IN_USE_SECONDS:
                terminal.warn(f"error: {reason}")
                return 2
            time.sleep(0.5)
        except ConfigError as mistake:
            terminal.warn(f"error: {mistake}")
            return 2


if __name__ == "__main__":
    sys.exit(main())
