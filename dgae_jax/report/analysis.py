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
        out += [_improvement(one.task, [(one, other)]) for one, other in duels]
        first = [(one, other) for one, other in duels if one.number == 0]
        out += [_improvement(ALL, first)] if len(first) > 1 else []
    return out


def _improvement(task: str, duels: Sequence[tuple[Group, Group]]) -> Improvement:
    better, worse = [one.finals for one, _ in duels], [other.finals for _, other in duels]
    return Improvement(task, *duels[0], improvement(better, worse))


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


def best_mean(groups: Iterable[Group]) -> float | None:
    """Return the highest training return of the groups, averaged over seeds; None without one."""
    curves = [group.curve[1] for group in groups]
    return max((float(curve.mean(0).max()) for curve in curves if curve.size), default=None)


def reached(group: Group, best: float | None) -> list[int | None]:
    """Return the samples after which the mean over seeds reaches each share `REACH` of `best`.

    None for a share that is not reached, and for all if `best` is not positive.
    """
    steps, curve = group.curve
    if best is None or best <= 0 or not curve.size:
        return [None] * len(REACH)
    above = [steps[curve.mean(0) >= share * best] for share in REACH]
    return [int(found[0]) if len(found) else None for found in above]
