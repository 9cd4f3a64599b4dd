"""The course of a study: what is done is skipped, what is not is launched, and what comes of it is written down at once."""

import contextlib
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from dgae_jax.run import terminal
from dgae_jax.run.options import RunOptions
from dgae_jax.run.runtime import Signals
from dgae_jax.study import results
from dgae_jax.study.launch import Launch, Task
from dgae_jax.study.matrix import Cell, Study
from dgae_jax.study.view import View
from dgae_jax.study.work import Job

LOOK_EVERY = 0.5
"""Seconds between looks at the tasks."""


def reproduce(study: Study, cells: Sequence[Cell], options: RunOptions, launch: Launch) -> int:
    """Train the cells that are not done, and keep `results.jsonl` up to date.

    0 all are done; 1 some failed; 128 + the signal if one came: the same call goes on. Raises ConfigError if the launcher cannot start.
    """
    jax.config.update(
        "jax_platforms", "cpu"
    )  # accelerators are the cells': what is read here is small
    rows = results.of_study(study)
    results.write(study, rows)
    jobs = [Job(study, cell, options) for cell in cells if cell.name not in rows]
    terminal.say(
        f"{study.path}: {len(cells) - len(jobs)} of {len(cells)} cells are done"
        + (f", {len(jobs)} to train" if jobs else "")
    )
    failed = []
    with (
        Signals() as signals,
        View(study, [job.cell for job in jobs]) as view,
        launch(jobs) if jobs else contextlib.nullcontext({}) as tasks,
    ):
        waiting = dict(tasks)
        while waiting and not signals.received:
            for task in [task for task in waiting if task.done()]:
                cell = waiting.pop(task).cell
                if reason := _failure(study, cell, task):
                    failed.append(cell.name)
                    view.note(cell, "failed", f"{cell.name}: {reason}")
                    continue
                rows[cell.name] = results.rows_of(study, cell)
                results.write(study, rows)
                view.note(cell, "done", *_done(cell, rows[cell.name]))
            view.look()
            time.sleep(LOOK_EVERY)
        if waiting:
            terminal.say(f"stopping {len(waiting)} cells")
    if signals.received:
        terminal.say(f"stopped by {signals.name}; the same command goes on")
        return signals.exit_code
    for name in failed:
        terminal.warn(f"failed: {name}, see {study.path / 'logs' / name}.log")
    return 1 if failed else 0


def _failure(study: Study, cell: Cell, task: Task) -> str | None:
    """Why a cell has no result, by the last line that it said."""
    try:
        code = task.result()
    except Exception as reason:  # of whatever kind the launcher's library raises
        return f"{type(reason).__name__}: {str(reason).partition(chr(10))[0][:200]}"
    if code == 0 and results.is_done(study, cell):
        return None
    lines = (
        study.log(cell).read_text(errors="replace").split("\n") if study.log(cell).is_file() else []
    )
    last = next((line for line in reversed(lines) if line.strip()), "it said nothing")
    return f"ended with exit code {code}: {last.strip()[:300]}"


def _done(cell: Cell, rows: list[dict[str, Any]]) -> tuple[str, float]:
    """A line about a cell that is done, and its mean return."""
    means = [row["final"]["return_mean"] for row in rows]
    spread = (
        f" ± {rows[0]['final']['return_std']:,.1f}"
        if len(rows) == 1
        else f", mean of {len(rows)} seeds"
    )
    mean = float(np.mean([np.nan if x is None else x for x in means]))
    return (
        f"{cell.name}: return {mean:,.1f}{spread}, {rows[0]['samples_per_second']:,.0f} steps/s",
        mean,
    )
