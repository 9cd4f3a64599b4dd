"""What several seeds say: point values, and intervals by the stratified bootstrap of Agarwal et al. 2021 (arXiv 2108.13264).

Scores are stratified by task: a list with the scores [S] of each task, which may have different numbers of seeds. The bootstrap
draws seeds within each task, with a fixed seed of its own, so that the same results give the same intervals.
"""

from collections.abc import Callable, Sequence

import numpy as np

Strata = Sequence[np.ndarray]
"""Scores [..., S] of each task."""

REPLICATES = 10_000
"""Draws of the bootstrap: the ends of an interval are then sure to about a hundredth of its width."""

LEVEL = 0.95


def mean_std(scores: np.ndarray) -> tuple[float, float | None]:
    """Mean and sample standard deviation (over S − 1) of scores [S]; None for the latter of a single score."""
    return float(scores.mean()), float(scores.std(ddof=1)) if len(scores) > 1 else None


def interquartile_mean(strata: Strata) -> np.ndarray:
    """Mean over all scores [...] without the lowest and the highest quarter of them, each rounded down to whole scores."""
    scores = np.sort(np.concatenate(strata, axis=-1), axis=-1)
    cut = scores.shape[-1] // 4
    return scores[..., cut : scores.shape[-1] - cut].mean(-1)


def improvement(better: Strata, worse: Strata) -> np.ndarray:
    """Probability [...] that a seed of `better` scores more than one of `worse`, ties counted half, the mean over tasks."""
    return np.mean([_wins(x, y) for x, y in zip(better, worse, strict=True)], axis=0)


def _wins(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    rivals = np.moveaxis(y, -1, 0)[
        ..., None
    ]  # one after the other: all pairs of all draws would be large
    return np.mean([((x > rival) + 0.5 * (x == rival)).mean(-1) for rival in rivals], axis=0)


def performance_profile(strata: Strata, taus: np.ndarray) -> np.ndarray:
    """Share [..., T] of all runs that score above each of `taus` [T]."""
    scores = np.concatenate(strata, axis=-1)
    return np.stack([(scores > tau).mean(-1) for tau in taus], axis=-1)


def difference(statistic: Callable[[Strata], np.ndarray]) -> Callable[[Strata, Strata], np.ndarray]:
    """The statistic of the second sample minus that of the first."""
    return lambda first, second: statistic(second) - statistic(first)


def interval(statistic: Callable[..., np.ndarray], *samples: Strata) -> np.ndarray | None:
    """The ends [2, ...] of the 95 % percentile interval of a statistic of independent samples.

    The statistic gets scores [R, S] of each task of each sample and returns [R, ...]. None where a task has a single seed, which says
    nothing about chance.
    """
    if any(len(scores) < 2 for strata in samples for scores in strata):
        return None
    generator = np.random.default_rng(0)
    drawn = [
        [
            scores[generator.integers(len(scores), size=(REPLICATES, len(scores)))]
            for scores in strata
        ]
        for strata in samples
    ]
    return np.quantile(statistic(*drawn), [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)


def common_curve(
    curves: Sequence[tuple[np.ndarray, np.ndarray]], points: int = 200
) -> tuple[np.ndarray, np.ndarray]:
    """Curves (steps [I], values [I] with NaN where there is none) at the steps [P] that all of them cover: values [S, P].

    The steps are those of the curves, evenly thinned to `points`; between its own steps a curve is linear. Curves without values
    are left out.
    """
    known = [(steps[np.isfinite(values)], values[np.isfinite(values)]) for steps, values in curves]
    known = [(steps, values) for steps, values in known if len(steps)]
    if not known:
        return np.empty(0), np.empty((0, 0))
    first, last = max(steps[0] for steps, _ in known), min(steps[-1] for steps, _ in known)
    grid = np.unique(np.concatenate([steps for steps, _ in known]))
    grid = grid[(grid >= first) & (grid <= last)]
    grid = grid[np.linspace(0, len(grid) - 1, min(len(grid), points)).round().astype(int)]
    return grid, np.array([np.interp(grid, steps, values) for steps, values in known])


def steps_to_reach(steps: np.ndarray, values: np.ndarray, threshold: float) -> int | None:
    """The first of `steps` [P] at which `values` [P] are at the threshold or above; None if they never are."""
    reached = steps[values >= threshold]
    return int(reached[0]) if len(reached) else None
