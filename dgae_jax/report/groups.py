"""Rows that belong together: the seeds of one task, one algorithm and the same settings."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.serial import flat
from dgae_jax.envs.registry import TASKS
from dgae_jax.report import statistics
from dgae_jax.report.results import Row

SEEDS = ("schema", "seed", "num_seeds")
"""What of a configuration does not make another experiment of it."""


@dataclass(frozen=True)
class Group:
    """The seeds of one experiment."""

    task: str
    algo: str
    variant: str
    """Its name among the variants of a question; else what differs from the first settings of this task and algorithm, empty for
    those themselves."""
    number: int
    """0 for the first settings, 1 for the next."""
    rows: tuple[Row, ...]

    @property
    def name(self) -> str:
        """As people read it."""
        return f"{self.algo.upper()} ({self.variant})" if self.variant else self.algo.upper()

    @property
    def finals(self) -> np.ndarray:
        """[S] mean returns of the last policies."""
        return np.array([row.final for row in self.rows])

    @property
    def worst(self) -> np.ndarray:
        """[S] mean returns of the worst quarter of their episodes."""
        return np.array([row.worst for row in self.rows])

    @property
    def averages(self) -> np.ndarray:
        """[S] episode returns while training, averaged over the run."""
        return np.array([row.average for row in self.rows])

    @property
    def curve(self) -> tuple[np.ndarray, np.ndarray]:
        """Steps [P] that all seeds cover and the episode returns [S, P] there while training."""
        return statistics.common_curve([(row.curve_steps, row.curve_returns) for row in self.rows])


def groups_of(rows: Iterable[Row]) -> list[Group]:
    """All groups, by task and algorithm in the order of their tables, then as the study has them."""
    by_kind: dict[tuple[str, str], dict[tuple[str | None, str], list[Row]]] = {}
    for row in sorted(rows, key=order):
        by_kind.setdefault((row.task, row.algo), {}).setdefault((row.variant, row.hash), []).append(
            row
        )
    return [
        Group(
            task,
            algo,
            _variant(next(iter(variants.values()))[0], members[0], number),
            number,
            tuple(members),
        )
        for (task, algo), variants in by_kind.items()
        for number, members in enumerate(variants.values())
    ]


def by_task(groups: Iterable[Group]) -> dict[str, list[Group]]:
    """The groups of each task."""
    out: dict[str, list[Group]] = {}
    for group in groups:
        out.setdefault(group.task, []).append(group)
    return out


def shown(value: Any) -> str:
    """The value of a setting as it is written on a command line."""
    return (
        " ".join(map(str, value))
        if isinstance(value, list)
        else "–"
        if value is None
        else str(value)
    )


def order(row: Row) -> tuple:
    """What rows are sorted by: task, algorithm, seed; what is alike in these stays as the study has it."""
    tasks = list(TASKS)
    place = tasks.index(row.env) if row.env in tasks else len(tasks)
    return place, row.task, list(ALGORITHMS).index(row.algo), row.seed


def _variant(first: Row, other: Row, number: int, most: int = 3) -> str:
    if other.variant or not number:
        return (other.variant or "").removesuffix("+noise")  # the task says so
    ours, theirs = flat(first.config), flat(other.config)
    differ = [
        name
        for name in {**ours, **theirs}
        if name not in SEEDS and ours.get(name) != theirs.get(name)
    ]
    named = [f"{name} {shown(theirs.get(name))}" for name in differ[:most]] or [other.hash]
    return ", ".join(named) + (f" and {len(differ) - most} more" if len(differ) > most else "")
