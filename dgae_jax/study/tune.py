"""A tuning on this machine: its processes, what they report, and what is left when they are through."""

import contextlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.run import files, terminal
from dgae_jax.study.tuning import Tuning

POLL = 0.5
"""Time between looks at what the workers have finished [s]."""


def tune(tuning: Tuning) -> int:
    """Finish the trials of a tuning, together with all others that work on it, and write what came of it.

    0 done; 1 if workers broke down, so that trials are missing; 129 / 130 / 143 stopped by a signal. Raises ConfigError if the
    directory cannot be written, or the database not be reached or tunes something else.
    """
    try:
        (tuning.directory / "trials").mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        raise invalid(
            "study", tuning.directory, f"a directory that can be written ({reason.strerror})"
        ) from reason
    from dgae_jax.run.runtime import Signals
    from dgae_jax.study import outcome
    from dgae_jax.study.storage import open_storage, open_study
    from dgae_jax.study.trials import finished, is_over

    study = open_study(tuning, open_storage(tuning))
    for path, value in tuning.outside.items():
        terminal.say(
            f"the start's own {path} {value} is outside of {tuning.space[path]}, so it is no trial"
        )
    progress = outcome.Progress(study)
    with Signals() as signals:
        processes = [] if is_over(study, tuning) else start(tuning)
        told = False
        while any(process.is_alive() for process in processes):
            progress.show()
            if signals.received and not told:
                told = True
                for process in processes:
                    _tell(process, signals.received)
            time.sleep(POLL)
        progress.show()
    _explain(tuning, processes, stopped=told)
    if not is_over(study, tuning):
        count = f"{len(finished(study))} of {tuning.trials} trials are finished; the same command goes on"
        terminal.say(f"stopped by {signals.name}: {count}" if told else f"stopped: {count}")
        return signals.exit_code if told else 1
    try:
        with files.turn(tuning.directory):
            return outcome.write(tuning, study)
    except OSError as reason:
        raise ConfigError(
            f"{reason.filename}: must be a file that can be written ({reason.strerror})"
        ) from reason


def start(tuning: Tuning) -> Sequence[BaseProcess]:
    """The workers, each on cores of its own."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    context = multiprocessing.get_context("spawn")
    processes = [
        context.Process(target=_work, args=(tuning, number, cores[number :: tuning.workers]))
        for number in range(tuning.workers)
    ]
    for process in processes:
        process.start()
    return processes


def _work(tuning: Tuning, number: int, cores: list[int]) -> None:
    """A worker's life. A group of its own: Ctrl-C reaches the first process only, which passes it on once."""
    os.setpgid(0, 0)
    signal.signal(
        signal.SIGINT, signal.SIG_DFL
    )  # until the worker listens there is nothing to save
    if cores:
        os.sched_setaffinity(0, cores)
    log = os.open(
        tuning.directory / f"worker-{number}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666
    )
    os.dup2(log, 1)
    os.dup2(log, 2)
    terminal.prepare()
    from dgae_jax.study.worker import serve

    sys.exit(serve(tuning, number))


def _tell(process: BaseProcess, kind: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError, TypeError):  # it has ended meanwhile
        os.kill(process.pid, kind)  # pyright: ignore[reportArgumentType]


def _explain(tuning: Tuning, processes: Sequence[BaseProcess], stopped: bool) -> None:
    """Say which workers were lost."""
    for number, process in enumerate(processes):
        process.join()
        code = process.exitcode or 0
        if code and not (stopped and code != 1):
            log = tuning.directory / f"worker-{number}.log"
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            terminal.warn(f"worker {number} ended with {how}: {_last_line(log)} ({log})")


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
    return lines[-1] if lines else "no output"
