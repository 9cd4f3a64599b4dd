"""The course of a sweep: launch the runs that are not done, show how far they are, keep results."""

import contextlib
import json
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

import jax
from rich.console import Console

from dgae_jax.run import terminal
from dgae_jax.run.options import RunOptions
from dgae_jax.run.runtime import Signals
from dgae_jax.study import results
from dgae_jax.study.launch import Launch
from dgae_jax.study.sweep import RunSpec, Sweep
from dgae_jax.study.worker import Job

POLL = 0.5
"""Time between looks at the tasks [s]."""

PLAIN_EVERY = 30.0
"""Time between lines where there is no terminal [s]."""

TAIL = 16_384
"""Bytes at the end of a metrics file that hold its last row."""


def reproduce(sweep: Sweep, runs: Sequence[RunSpec], options: RunOptions, launch: Launch) -> int:
    """Train the runs that are not done, and keep `results.jsonl` up to date.

    Args:
        sweep: the sweep, opened by this process.
        runs: those of its runs that are asked for.
        options: options of every run.
        launch: the launcher.

    Returns:
        The exit code: 0 all are done, 1 some failed, 128 + a signal that came.

    Raises:
        ConfigError: the launcher cannot start.
    """
    jax.config.update("jax_platforms", "cpu")  # accelerators are left to the runs
    rows = results.read(sweep)
    results.write(sweep, rows)
    jobs = [Job(sweep, run, options) for run in runs if run.name not in rows]
    left = f", {len(jobs)} to train" if jobs else ""
    terminal.say(f"{sweep.path}: {len(runs) - len(jobs)} of {len(runs)} runs are done{left}")
    with (
        Signals() as signals,
        Progress(sweep, [job.run for job in jobs]) as progress,
        launch(jobs) if jobs else contextlib.nullcontext({}) as tasks,
    ):
        waiting = dict(tasks)
        while waiting and not signals.received:
            for task in [task for task in waiting if task.done()]:
                run = waiting.pop(task).run
                if reason := _failure(sweep, run, task):
                    progress.note(run, "failed", f"{run.name}: {reason}")
                    continue
                rows[run.name] = results.rows_of(sweep, run)
                results.write(sweep, rows)
                progress.note(run, "done", _summary(run, rows[run.name]))
            progress.show()
            time.sleep(POLL)
        if waiting:
            terminal.say(f"stopping {len(waiting)} runs")
    if signals.received:
        terminal.say(f"stopped by {signals.name}; the same command continues")
        return signals.exit_code
    failed = [name for name, state in progress.ended.items() if state == "failed"]
    for name in failed:
        terminal.warn(f"failed: {name}, see {sweep.path / 'logs' / name}.log")
    return 1 if failed else 0


def _failure(sweep: Sweep, run: RunSpec, task: Any) -> str | None:
    """Return why a run has no result, by the last line of its log."""
    try:
        code = task.result()
    except Exception as reason:  # of whatever kind the launcher's library raises
        return f"{type(reason).__name__}: {str(reason).partition(chr(10))[0][:200]}"
    if code == 0 and results.is_done(sweep, run):
        return None
    log = sweep.log(run)
    lines = log.read_text(errors="replace").strip().splitlines() if log.is_file() else []
    return f"ended with exit code {code}: {lines[-1][:300] if lines else 'no output'}"


def _summary(run: RunSpec, rows: results.Rows) -> str:
    means = [row["final"]["return_mean"] for row in rows]
    shown = " ".join("not finite" if mean is None else f"{mean:,.1f}" for mean in means)
    return f"{run.name}: return {shown}, {rows[0]['samples_per_second']:,.0f} steps/s"


def reached(sweep: Sweep, run: RunSpec) -> int:
    """Return the steps in the last whole row of the metrics of a run."""
    try:
        with (sweep.run_dir(run) / "metrics.jsonl").open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            return json.loads(file.read().rpartition(b"\n")[0].rpartition(b"\n")[2])["steps"]
    except (OSError, ValueError, LookupError, TypeError):
        return 0


class Progress:
    """Shows how far the runs are, as a status line on a terminal and as lines elsewhere."""

    def __init__(self, sweep: Sweep, runs: Sequence[RunSpec]):
        self.sweep, self.runs, self.ended = sweep, runs, dict[str, str]()
        self.began = self.printed = time.monotonic()
        self.steps_before = self._steps()
        console = Console(file=terminal.Steady(sys.stdout))
        self.status = console.status("") if terminal.is_live() else None

    def __enter__(self) -> "Progress":
        if self.status:
            self.status.start()
        return self

    def __exit__(self, *_) -> None:
        if self.status:
            self.status.stop()

    def note(self, run: RunSpec, state: str, text: str) -> None:
        """Note that a run is done or has failed, and print a line about it."""
        self.ended[run.name] = state
        if self.status:
            self.status.console.print(text, markup=False, highlight=False)
        else:
            terminal.say(text)

    def show(self) -> None:
        """Read what the runs have written, and show it."""
        if self.status:
            self.status.update(self._line())
        elif time.monotonic() - self.printed > PLAIN_EVERY:
            self.printed = time.monotonic()
            terminal.say(self._line())

    def _steps(self) -> int:
        return sum(reached(self.sweep, run) * run.config.num_seeds for run in self.runs)

    def _line(self) -> str:
        configs = [run.config for run in self.runs]
        total = sum(c.iterations * c.samples_per_iteration * c.num_seeds for c in configs)
        steps, seconds = self._steps(), time.monotonic() - self.began
        made = steps - self.steps_before
        clock = terminal.clock((total - steps) * seconds / made) if made else "unknown"
        states = list(self.ended.values())
        counts = f"{states.count('done')} done, {states.count('failed')} failed"
        of = f"of {len(self.runs)} runs; {steps:,} of {total:,} steps"
        return f"{counts} {of}, time left {clock}"
