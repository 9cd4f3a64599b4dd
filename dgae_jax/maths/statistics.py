"""Quality of predicted distributions (JAX), and uncertainty over seeds (NumPy, on the host)."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dgae_jax.maths.transport import quantile_midpoints

Outcomes = Float[Array, "*batch"]
Quantiles = Float[Array, "*batch K"]


def explained_variance(prediction: Outcomes, outcome: Outcomes) -> Float[Array, ""]:
    """Compute 1 − Var[outcome − prediction] / Var[outcome]; NaN where the outcome does not vary."""
    variance = outcome.var()
    residual = (outcome - prediction).var()
    return jnp.where(variance > 0, 1 - residual / jnp.where(variance > 0, variance, 1), jnp.nan)


def pit(quantiles: Quantiles, outcome: Outcomes) -> Outcomes:
    """Compute the share of quantiles at or below the outcome, uniform for a calibrated critic."""
    return (quantiles <= outcome[..., None]).mean(-1)


def coverage(quantiles: Quantiles, outcome: Outcomes, level: float = 0.9) -> Float[Array, ""]:
    """Compute the share of outcomes inside the central interval that should hold `level` of them.

    Args:
        quantiles: Values at the midpoints 1/2K … 1 − 1/2K, in any order.
        outcome: Observed values.
        level: Nominal share, in (0, 1). K quantiles give levels up to 1 − 1/K.

    Returns:
        The share; NaN for levels above 1 − 1/K (0.9 with K < 10). The ends of such an interval lie
        outside the midpoints, and an extrapolation would assume a shape of the tails.

    Raises:
        ValueError: `level` is outside (0, 1).
    """
    tail, k = _tail(level), quantiles.shape[-1]
    if tail < (1 - 1e-9) / (2 * k):
        return jnp.full((), jnp.nan)
    grid, ordered = quantile_midpoints(k), jnp.sort(quantiles)
    at = jnp.vectorize(lambda q, z: jnp.interp(q, grid, z), signature="(),(k)->()")
    return ((at(tail, ordered) <= outcome) & (outcome <= at(1 - tail, ordered))).mean()


def crps(quantiles: Quantiles, outcome: Outcomes) -> Outcomes:
    """Compute the continuous ranked probability score, 2 ∫ ρ_τ(y − F⁻¹(τ)) dτ; lower is better.

    ρ is the pinball loss at the midpoints. Quantiles are sorted first, because a network's may
    cross.
    """
    u = outcome[..., None] - jnp.sort(quantiles)
    tau = quantile_midpoints(quantiles.shape[-1])
    return 2 * (u * (tau - (u < 0))).mean(-1)


Samples = np.ndarray | jax.Array | Sequence[Any]
"""Samples [..., S], or a list with the samples [..., S] of each stratum, of any size S."""


def iqm(samples: Samples) -> np.ndarray | np.floating:
    """Compute the interquartile mean (Agarwal et al. 2021, arXiv:2108.13264).

    Args:
        samples: [..., S], or a list with the samples [..., S] of each stratum, which are pooled.

    Returns:
        Mean [...] without the lowest and the highest ⌊S/4⌋ samples.
    """
    pooled = np.sort(np.concatenate(_strata(samples), axis=-1), axis=-1)
    cut = pooled.shape[-1] // 4
    return pooled[..., cut : pooled.shape[-1] - cut].mean(-1)


def bootstrap_interval(
    samples: Samples,
    statistic: Callable[[Any], Any] = iqm,
    *,
    level: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> np.ndarray:
    """Compute the stratified percentile bootstrap interval of a statistic (Agarwal et al. 2021).

    Args:
        samples: Independent samples [S], one per seed, or a list with the samples of each stratum.
            Strata keep their sizes: seeds are drawn within each task.
        statistic: Function of the draws, which have the form of `samples` with a leading axis
            [resamples]; it reduces the last axis.
        level: Share of the statistic's draws inside the interval, in (0, 1).
        resamples: Number of draws; 10,000 fix the ends to about a hundredth of the width.
        seed: Seed of the draws: the same samples give the same interval.

    Returns:
        Lower and upper end [2, ...].

    Raises:
        ValueError: `level` is outside (0, 1).
    """
    tail = _tail(level)
    generator, strata = np.random.default_rng(seed), _strata(samples)
    draws = [x[generator.integers(len(x), size=(resamples, len(x)))] for x in strata]
    found = statistic(draws if _stratified(samples) else draws[0])
    return np.quantile(found, [tail, (1 + level) / 2], axis=0)


def sample_cvar(samples: np.ndarray, share: float) -> float:
    """Compute the mean of the lowest `share` of samples [S], of one sample at least."""
    return float(np.sort(samples)[: max(1, round(share * len(samples)))].mean())


def _stratified(samples: Samples) -> bool:
    return isinstance(samples, Sequence) and np.ndim(samples[0]) > 0


def _strata(samples: Samples) -> list[np.ndarray]:
    return [np.asarray(x) for x in (samples if _stratified(samples) else [samples])]


def _tail(level: float) -> float:
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval is {level}; it must lie between 0 and 1")
    return (1 - level) / 2
