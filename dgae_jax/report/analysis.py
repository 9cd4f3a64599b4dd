"""Comparisons of groups: intervals, pairs of algorithms, normalised scores, sample efficiency."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.maths.statistics import bootstrap_interval, iqm
from dgae_jax.report.groups import Group, by_task

ALL = "all tasks"

REACH = (0.5, 0.9)
"""Shares of the best mean return of a task."""

Strata = Sequence[np.ndarray]
"""Scores [..., S] of each task."""


class Estimate(NamedTuple):
    """A number and its 95 % interval; None with a single seed."""

    value: float
    interval: np.ndarray | None


class Improvement(NamedTuple):
    """P(better > worse) on one task, or over all tasks that have both."""

    task: str
    better: Group
    worse: Group
    estimate: Estimate


def interval(statistic: Callable[[Any], Any], strata: Strata) -> np.ndarray | None:
    """Return the 95 % interval of a statistic, or None if a task has a single seed."""
    if min(map(len, strata)) < 2:
        return None
    return bootstrap_interval(list(strata), statistic)


def interquartile_mean(scores: np.ndarray) -> Estimate:
    """Estimate the interquartile mean of scores [S]."""
    return _estimate(iqm, [scores])


def difference(first: np.ndarray, second: np.ndarray) -> Estimate:
    """Estimate the difference of the interquartile means of scores [S], second minus first."""
    return _estimate(lambda scores: iqm(scores[1:]) - iqm(scores[:1]), [first, second])


def improvement(better: Strata, worse: Strata) -> Estimate:
    """Estimate the probability that a seed of `better` scores higher than one of `worse`.

    Ties count half; the probability is averaged over tasks (Agarwal et al. 2021).
    """
    tasks = len(better)

    def probability(strata: Strata) -> np.ndarray:
        pairs = zip(strata[:tasks], strata[tasks:], strict=True)
        return np.mean([_wins(x, y) for x, y in pairs], axis=0)

    return _estimate(probability, [*better, *worse])


def _estimate(statistic: Callable[[Any], Any], strata: Strata) -> Estimate:
    return Estimate(float(statistic(strata)), interval(statistic, strata))


def _wins(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    # one rival at a time: all pairs of all draws would need much memory
    rivals = np.moveaxis(y, -1, 0)[..., None]
    return np.mean([((x > rival) + 0.5 * (x == rival)).mean(-1) for rival in rivals], axis=0)


def performance_profile(strata: Strata, taus: np.ndarray) -> np.ndarray:
    """Return the share [..., T] of all seeds that score above each of `taus` [T]."""
    scores = np.concatenate(strata, axis=-1)
    return np.stack([(scores > tau).mean(-1) for tau in taus], axis=-1)


def pairs() -> list[tuple[str, str]]:
    """Return each distributional algorithm with the scalar one of the same policy update."""
    return [
        (one, other)
        for one, better in ALGORITHMS.items()
        for other, worse in ALGORITHMS.items()
        if (better.residual, worse.residual) == ("distributional", "td")
        and better.policy_update == worse.policy_update
    ]


def improvements(groups: Iterable[Group]) -> list[Improvement]:
    """Compare each distributional group with the first scalar one of its task and pair.

    The first distributional groups are compared over all tasks, too.
    """
    groups, out = list(groups), []
    for better, worse in pairs():
        duels = [
            (one, other)
            for members in by_task(groups).values()
            for one in members
            for other in members
            if (one.algo, other.algo, other.number) == (better, worse, 0)
        ]
        first = [(one, other) for one, other in duels if one.number == 0]
        named = [(one.task, [(one, other)]) for one, other in duels]
        for task, both in [*named, (ALL, first)] if len(first) > 1 else named:
            ours, theirs = ([group.finals for group in side] for side in zip(*both, strict=True))
            out.append(Improvement(task, *both[0], improvement(ours, theirs)))
    return out


def normalised(groups: Iterable[Group]) -> dict[str, tuple[Group, list[np.ndarray]]]:
    """Divide final returns by the best mean of their task, if it is positive.

    By name: a group and the scores [S] of each of its tasks.
    """
    out: dict[str, tuple[Group, list[np.ndarray]]] = {}
    for members in by_task(groups).values():
        best = max(group.finals.mean() for group in members)
        for group in members if best > 0 else ():
            out.setdefault(group.name, (group, []))[1].append(group.finals / best)
    return out


def reached(groups: Sequence[Group]) -> tuple[float | None, list[list[int | None]]]:
    """Return a task's highest mean training return, and the samples to each share `REACH` of it.

    Means are over seeds. None for a share that a group does not reach, and without returns.
    """
    curves = [group.curve for group in groups]
    means = [curve.mean(0) if curve.size else np.empty(0) for _, curve in curves]
    best = max((float(mean.max()) for mean in means if mean.size), default=None)
    shares = [share * best if best and best > 0 else np.inf for share in REACH]
    found = []
    for (steps, _), mean in zip(curves, means, strict=True):
        above = [steps[mean >= share] for share in shares]
        found.append([int(some[0]) if len(some) else None for some in above])
    return best, found
