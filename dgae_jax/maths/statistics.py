"""Quality of predictions, and the uncertainty of a mean over seeds."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from dgae_jax.maths.transport import quantile_midpoints


def explained_variance(
    prediction: Float[Array, "*shape"], outcome: Float[Array, "*shape"]
) -> Float[Array, ""]:
    """1 − Var[outcome − prediction] / Var[outcome]: 1 is perfect, 0 no better than a constant.

    NaN where the outcome does not vary.
    """
    variance = outcome.var()
    return jnp.where(
        variance > 0,
        1 - (outcome - prediction).var() / jnp.where(variance > 0, variance, 1),
        jnp.nan,
    )


def pit(
    quantiles: Float[Array, "*batch K"], outcome: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Probability integral transform: the share of quantiles at or below the outcome, uniform for a calibrated critic."""
    return (quantiles <= outcome[..., None]).mean(-1)


def coverage(
    quantiles: Float[Array, "*batch K"], outcome: Float[Array, "*batch"], level: float = 0.9
) -> Float[Array, ""]:
    """Share of outcomes inside the central interval that should hold `level` of them; K quantiles give levels up to 1 − 1/K.

    NaN for higher levels, 0.9 with K < 10: the ends of the interval, F⁻¹((1 ± level)/2), then lie outside the midpoints 1/2K …
    1 − 1/2K. Ending it at the outermost ones would hold only 1 − 1/K of the outcomes of a calibrated critic, and an
    extrapolation would assume a shape of the tails.
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval is {level}; it must lie between 0 and 1")
    tail, k = (1 - level) / 2, quantiles.shape[-1]
    if tail < (1 - 1e-9) / (2 * k):
        return jnp.full((), jnp.nan)
    grid, ordered = quantile_midpoints(k), jnp.sort(quantiles)
    at = jnp.vectorize(lambda q, z: jnp.interp(q, grid, z), signature="(),(k)->()")
    return ((at(tail, ordered) <= outcome) & (outcome <= at(1 - tail, ordered))).mean()


def crps(
    quantiles: Float[Array, "*batch K"], outcome: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Continuous ranked probability score, 2 ∫ ρ_τ(y − F⁻¹(τ)) dτ with the pinball loss ρ at the midpoints; lower is better.

    Quantiles are sorted first, because a network's may cross.
    """
    u = outcome[..., None] - jnp.sort(quantiles)
    tau = quantile_midpoints(quantiles.shape[-1])
    return 2 * (u * (tau - (u < 0))).mean(-1)


def iqm(samples: Float[Array, " S"]) -> Float[Array, ""]:
    """Interquartile mean: the mean without the lowest and the highest ⌊S/4⌋ samples (Agarwal et al. 2021)."""
    cut = samples.shape[0] // 4
    return jnp.sort(samples)[cut : samples.shape[0] - cut].mean()


def bootstrap_interval(
    key: Key[Array, ""],
    samples: Float[Array, " S"],
    statistic: Callable[[Array], Array] = iqm,
    *,
    level: float = 0.95,
    resamples: int = 2_000,
) -> Float[Array, "2"]:
    """Percentile bootstrap interval (low, high) of a statistic of independent samples, one per seed."""
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval is {level}; it must lie between 0 and 1")
    draws = jax.random.choice(key, samples, (resamples, samples.shape[0]))
    tail = (1 - level) / 2
    return jnp.quantile(jax.vmap(statistic)(draws), jnp.array([tail, 1 - tail]))
