"""How a study is going: all of the matrix on a terminal, lines when piped. What cells do is read from their files."""

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table

from dgae_jax.run import terminal
from dgae_jax.run.terminal import clock
from dgae_jax.study.matrix import Cell, Study

PLAIN_EVERY = 30.0
"""Seconds between lines when piped."""
TAIL = 16_384
"""Bytes at the end of a metrics file that hold its last rows."""


class Reached(NamedTuple):
    """How far a cell is."""

    steps: int
    episode_return: float | None


def reached(study: Study, cell: Cell) -> Reached:
    """By the last whole row of its metrics."""
    try:
        with (study.run_dir(cell) / "metrics.jsonl").open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            last = json.loads(file.read().rpartition(b"\n")[0].rpartition(b"\n")[2])
        return Reached(int(last["steps"]), last["episode_return"])
    except (OSError, ValueError, LookupError, TypeError):
        return Reached(0, None)


class View:
    """Shows the cells of a study by task and algorithm: how many are done, run and failed, how far, with what returns."""

    def __init__(self, study: Study, cells: Sequence[Cell]):
        self.study, self.cells, self.state = (
            study,
            cells,
            dict.fromkeys((cell.name for cell in cells), "waiting"),
        )
        self.returns: dict[str, float] = {}
        self.began, self.printed = time.monotonic(), time.monotonic()
        self.before = {cell.name: reached(study, cell).steps for cell in cells}
        self.live = (
            Live(console=Console(file=terminal.Steady(sys.stdout)), auto_refresh=False)
            if terminal.is_live()
            else None
        )

    def __enter__(self) -> "View":
        if self.live:
            self.live.start()
        return self

    def __exit__(self, *_) -> None:
        self.look()
        if self.live:
            self.live.stop()

    def note(self, cell: Cell, state: str, text: str, mean_return: float | None = None) -> None:
        """A cell is done or failed; `text` is a line that says so."""
        self.state[cell.name] = state
        if mean_return is not None:
            self.returns[cell.name] = mean_return
        if self.live:
            self.live.console.print(text, markup=False, highlight=False)
        else:
            terminal.say(text)

    def look(self) -> None:
        """Read what the cells have written, and show it."""
        if not self.live and time.monotonic() - self.printed < PLAIN_EVERY:
            return
        far = {cell.name: reached(self.study, cell) for cell in self.cells}
        for name, state in self.state.items():
            if state == "waiting" and far[name].steps > self.before[name]:
                self.state[name] = "running"
        if self.live:
            self.live.update(self._table(far), refresh=True)
        else:
            self.printed = time.monotonic()
            terminal.say(self._line(far))

    def _line(self, far: dict[str, Reached]) -> str:
        count = Counter(self.state.values())
        parts = [
            f"{count[state]} {state}"
            for state in ("done", "running", "waiting", "failed")
            if count[state]
        ]
        return f"{', '.join(parts)} of {len(self.cells)} cells; {self._left(far)}"

    def _left(self, far: dict[str, Reached]) -> str:
        """At the speed so far."""
        seconds, ours = (
            time.monotonic() - self.began,
            [cell for cell in self.cells if self.state[cell.name] != "failed"],
        )
        made = sum(
            (far[cell.name].steps - self.before[cell.name]) * cell.config.num_seeds for cell in ours
        )
        total = sum(
            cell.config.iterations * cell.config.samples_per_iteration * cell.config.num_seeds
            for cell in ours
        )
        there = sum(far[cell.name].steps * cell.config.num_seeds for cell in ours)
        left = (
            f"about {clock((total - there) * seconds / made)} left"
            if made
            else "time left not known yet"
        )
        return f"{there:,} of {total:,} steps, {left}"

    def _table(self, far: dict[str, Reached]) -> Group:
        table = Table(box=None, pad_edge=False)
        for name in ("task", "algorithm", "done", "running", "failed", "steps", "return"):
            table.add_column(name, justify="left" if name in ("task", "algorithm") else "right")
        groups: dict[tuple[str, str], list[Cell]] = {}
        for cell in self.cells:
            groups.setdefault((cell.config.env, str(cell.config.algo)), []).append(cell)
        for (task, algo), cells in groups.items():
            table.add_row(task, algo, *self._numbers(cells, far))
        return Group(self._line(far), table)

    def _numbers(self, cells: Sequence[Cell], far: dict[str, Reached]) -> list[str]:
        states = [self.state[cell.name] for cell in cells]
        share = np.mean(
            [
                far[cell.name].steps / (cell.config.iterations * cell.config.samples_per_iteration)
                for cell in cells
            ]
        )
        found: list[Any] = [
            self.returns.get(cell.name, far[cell.name].episode_return) for cell in cells
        ]
        known = [x for x in found if x is not None]
        shown = f"{np.mean(known):,.0f}" if known else "–"
        return [
            *(str(states.count(state) or "") for state in ("done", "running", "failed")),
            f"{share:.0%}",
            shown,
        ]
