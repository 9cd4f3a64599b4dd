"""Groups of rows: the seeds of one task, one algorithm and the same hyperparameters."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.envs.registry import TASKS
from dgae_jax.maths.statistics import sample_cvar
from dgae_jax.report.results import Row


@dataclass(frozen=True)
class Group:
    """The seeds of one experiment."""

    task: str
    algo: str
    variant: str
    """Name of the variant in an ablation; else the differences from the first group of this task
    and algorithm, empty for that group."""
    number: int
    """0 for the first group of this task and algorithm, 1 for the next."""
    rows: tuple[Row, ...]

    @property
    def name(self) -> str:
        """Label in tables and figures."""
        return f"{self.algo.upper()} ({self.variant})" if self.variant else self.algo.upper()

    @property
    def finals(self) -> np.ndarray:
        """Mean returns [S] of the final policies."""
        return np.array([row.final for row in self.rows])

    @property
    def worst(self) -> np.ndarray:
        """Mean returns [S] of the worst quarter of the final policies' episodes."""
        return np.array([sample_cvar(row.returns, 0.25) for row in self.rows])

    @property
    def averages(self) -> np.ndarray:
        """Episode returns [S] averaged over training; NaN if no episode ended."""
        curves = [row.curve_returns[np.isfinite(row.curve_returns)] for row in self.rows]
        return np.array([curve.mean() if curve.size else np.nan for curve in curves])

    @property
    def curve(self) -> tuple[np.ndarray, np.ndarray]:
        """Steps [P] that all seeds have and their episode returns [S, P] during training.

        Seeds in which no episode ended are left out.
        """
        rows = [zip(row.curve_steps, row.curve_returns, strict=True) for row in self.rows]
        known = [{step: x for step, x in row if np.isfinite(x)} for row in rows]
        curves = [curve for curve in known if curve]
        steps = sorted(set.intersection(*map(set, curves))) if curves else []
        return np.array(steps), np.array([[curve[step] for step in steps] for curve in curves])


def groups_of(rows: Iterable[Row]) -> list[Group]:
    """Group rows by task and algorithm, then by variant and settings in the order of the rows."""
    by_kind: dict[tuple[str, str], dict[tuple[str | None, str], list[Row]]] = {}
    for row in sorted(rows, key=order):
        key = row.variant, json.dumps(row.settings, sort_keys=True)
        by_kind.setdefault((row.task, row.algo), {}).setdefault(key, []).append(row)
    groups = []
    for (task, algo), variants in by_kind.items():
        members = list(variants.values())
        for number, seeds in enumerate(members):
            variant = _variant(members[0][0], seeds[0], number)
            groups.append(Group(task, algo, variant, number, tuple(seeds)))
    return groups


def by_task(groups: Iterable[Group]) -> dict[str, list[Group]]:
    """Return the groups of each task; they must be in the order of `groups_of`."""
    return {task: list(members) for task, members in groupby(groups, lambda group: group.task)}


def order(row: Row) -> tuple:
    """Return the sort key of a row: task, algorithm, seed."""
    tasks = list(TASKS)
    place = tasks.index(row.env) if row.env in tasks else len(tasks)
    return place, row.task, list(ALGORITHMS).index(row.algo), row.seed


def shown(value: Any) -> str:
    """Return the value of a setting as on a command line."""
    if isinstance(value, list):
        return " ".join(map(str, value))
    return "–" if value is None else str(value)


def _variant(first: Row, other: Row, number: int, most: int = 3) -> str:
    if other.variant or not number:
        return (other.variant or "").removesuffix("+noise")  # the task says so
    ours, theirs = first.settings, other.settings
    differ = [name for name in {**ours, **theirs} if ours.get(name) != theirs.get(name)]
    named = ", ".join(f"{name} {shown(theirs.get(name))}" for name in differ[:most])
    return named + (f" and {len(differ) - most} more" if len(differ) > most else "")
