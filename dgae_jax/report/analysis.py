"""What a report says of groups: summaries, pairs of algorithms, scores that tasks can share, samples to reach a return."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.report import statistics
from dgae_jax.report.groups import Group, by_task

ALL = "all tasks"

REACH = (0.5, 0.9)
"""Shares of the best mean return of a task."""


class Estimate(NamedTuple):
    """A number and its 95 % interval; None where there is a single seed."""

    value: float
    interval: np.ndarray | None


class Improvement(NamedTuple):
    """P(better > worse) on one task, or over all that have both."""

    task: str
    better: Group
    worse: Group
    estimate: Estimate


def estimate(statistic, *samples: statistics.Strata) -> Estimate:
    """A statistic of samples, with its interval."""
    return Estimate(float(statistic(*samples)), statistics.interval(statistic, *samples))


def interquartile_mean(scores: np.ndarray) -> Estimate:
    """Of scores [S]."""
    return estimate(statistics.interquartile_mean, [scores])


def pairs() -> Iterator[tuple[str, str]]:
    """Each distributional algorithm with the scalar one that updates its policy in the same way."""
    for name, row in ALGORITHMS.items():
        if row.residual == "distributional":
            yield from (
                (name, o)
                for o, other in ALGORITHMS.items()
                if (other.residual, other.policy_update) == ("td", row.policy_update)
            )


def improvements(groups: Iterable[Group]) -> list[Improvement]:
    """For each pair: every distributional group of a task against the scalar one of the first settings; then over all tasks."""
    groups, out = list(groups), []
    for better, worse in pairs():
        duels = [
            (one, other)
            for members in by_task(groups).values()
            for one in members
            for other in members
            if (one.algo, other.algo, other.number) == (better, worse, 0)
        ]
        out += [_improvement(one.task, [(one, other)]) for one, other in duels]
        first = [(one, other) for one, other in duels if one.number == 0]
        out += [_improvement(ALL, first)] if len(first) > 1 else []
    return out


def _improvement(task: str, duels: Sequence[tuple[Group, Group]]) -> Improvement:
    better, worse = [one.finals for one, _ in duels], [other.finals for _, other in duels]
    return Improvement(task, *duels[0], estimate(statistics.improvement, better, worse))


def normalised(groups: Iterable[Group]) -> dict[str, tuple[Group, list[np.ndarray]]]:
    """By name a group and the scores [S] of each of its tasks: final returns over the best mean final return of the task.

    Tasks whose best mean is not positive have no such score and are left out.
    """
    out: dict[str, tuple[Group, list[np.ndarray]]] = {}
    for members in by_task(groups).values():
        best = max(group.finals.mean() for group in members)
        for group in members if best > 0 else ():
            out.setdefault(group.name, (group, []))[1].append(group.finals / best)
    return out


def best_mean(groups: Iterable[Group]) -> float | None:
    """The highest mean over seeds of the return while training, of all these groups; None where no episode has ended."""
    return max(
        (
            float(curve.mean(0).max())
            for _, curve in (group.curve for group in groups)
            if curve.size
        ),
        default=None,
    )


def reached(group: Group, best: float | None) -> list[int | None]:
    """Samples after which the mean over seeds reaches each share `REACH` of `best`; None if it does not, or if best is not positive."""
    if best is None or best <= 0:
        return [None] * len(REACH)
    steps, curve = group.curve
    return [
        statistics.steps_to_reach(steps, curve.mean(0), share * best) if curve.size else None
        for share in REACH
    ]
