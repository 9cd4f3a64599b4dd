"""Calibration of a critic: its quantiles against the returns that were observed."""

import jax.numpy as jnp
from jaxtyping import Array

from dgae_jax.learn.types import Metrics
from dgae_jax.maths.returns import Quantiles, Steps, bellman_target, lambda_return
from dgae_jax.maths.statistics import coverage, pit
from dgae_jax.maths.transport import directional_metric, wasserstein

SIMILAR = 0.1
"""Means count as similar where |d| is at most this share of W₁."""


def critic_diagnostics(
    reward: Steps,
    discount: Steps,
    continues: Steps,
    quantiles: Quantiles,
    next_quantiles: Quantiles,
) -> Metrics:
    """Compare a critic with Monte-Carlo returns.

    These are discounted sums to the end of the episode, or to the end of the rollout and the value
    there. `similar_means` is the share of steps with similar means and different shapes of target
    and prediction, |d(r + γG′, G)| ≤ 0.1 W₁(r + γG′, G) (Sec. results). `continues` is 1 where the
    episode continues, and the other arguments are those of `maths.returns`.
    """
    returns = lambda_return(reward, discount, continues, quantiles, next_quantiles)
    probability = pit(quantiles, returns)
    target = bellman_target(reward, discount, next_quantiles)
    crossing = (quantiles[..., 1:] < quantiles[..., :-1]).mean()
    return {
        "critic/wasserstein": jnp.abs(quantiles - returns[..., None]).mean(),
        "critic/crossing": crossing if quantiles.shape[-1] > 1 else jnp.zeros(()),
        "critic/coverage_90": coverage(quantiles, returns, 0.9),
        "critic/pit_mean": probability.mean(),
        "critic/pit_std": probability.std(),
        "critic/similar_means": similar_means(target, quantiles).mean(),
    }


def similar_means(target: Quantiles, quantiles: Quantiles, share: float = SIMILAR) -> Array:
    """Return where distributions differ in shape rather than in mean, |d| ≤ share · W₁."""
    difference = jnp.abs(directional_metric(target, quantiles))
    return difference <= share * wasserstein(target, quantiles)
