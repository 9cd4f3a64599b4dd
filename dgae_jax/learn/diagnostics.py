"""Calibration of a critic: its quantiles against the returns that were observed."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dgae_jax.maths.returns import bellman_target, lambda_return
from dgae_jax.maths.statistics import coverage, pit
from dgae_jax.maths.transport import directional_metric, wasserstein

SIMILAR = 0.1
"""Means count as similar where |d| is at most this share of W₁."""

Diagnose = Callable[..., dict[str, Array]]
"""`diagnose(reward, discount, continues, quantiles, next_quantiles) -> metrics`, of one rollout."""


def nothing(*_: Array) -> dict[str, Array]:
    """No diagnostics."""
    return {}


def of_critic(
    reward: Float[Array, "T N"],
    discount: Float[Array, "T N"],
    continues: Float[Array, "T N"],
    quantiles: Float[Array, "T N K"],
    next_quantiles: Float[Array, "T N K"],
) -> dict[str, Array]:
    """Calibration against Monte-Carlo returns: discounted sums to the episode's end, or to the rollout's and the value there.

    `continues` is 1 where the episode continues. `similar_means` is the share of steps whose target and prediction have similar
    means and different shapes, |d(r + γG′, G)| ≤ 0.1 W₁(r + γG′, G) (Sec. results).
    """
    outcome = lambda_return(reward, discount, continues, quantiles, next_quantiles)
    probability, target = pit(quantiles, outcome), bellman_target(reward, discount, next_quantiles)
    return {
        "critic/wasserstein": jnp.abs(quantiles - outcome[..., None]).mean(),
        "critic/crossing": (quantiles[..., 1:] < quantiles[..., :-1]).mean() if quantiles.shape[-1] > 1 else jnp.zeros(()),
        "critic/coverage_90": coverage(quantiles, outcome, 0.9),
        "critic/pit_mean": probability.mean(),
        "critic/pit_std": probability.std(),
        "critic/similar_means": similar_means(target, quantiles).mean(),
    }


def similar_means(target: Float[Array, "*batch K"], quantiles: Float[Array, "*batch K"], share: float = SIMILAR) -> Bool[Array, "*batch"]:
    """Whether two distributions differ in shape rather than in mean, |d| ≤ share · W₁ (Sec. results)."""
    return jnp.abs(directional_metric(target, quantiles)) <= share * wasserstein(target, quantiles)
