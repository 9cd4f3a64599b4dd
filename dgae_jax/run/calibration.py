"""How well a critic's distribution describes the returns that came, of the policy that acts as it did while training."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.learn.build import make_quantiles, make_task
from dgae_jax.learn.diagnostics import SIMILAR, similar_means
from dgae_jax.maths.returns import bellman_target
from dgae_jax.maths.statistics import coverage, crps, pit
from dgae_jax.run import outcomes, restore
from dgae_jax.run.compiling import Watch, unwatched

WORLDS = 64
"""Worlds side by side."""

SHARES = (SIMILAR, 0.03, 0.01, 0.003)
"""Of W₁, up to which |d| counts as that of similar means."""

BINS = 20
"""Of the histogram of the probability integral transform."""


def calibrate(
    source: Path,
    config: ResolvedConfig,
    *,
    which: str,
    index: int = 0,
    seed: int = 0,
    watch: Watch = unwatched,
) -> dict[str, Any]:
    """Statistics of the critic of a run, or in a file, over the `outcomes` of `WORLDS` worlds, actions drawn from the policy.

    Returns are of scaled rewards, as the critic's: `coverage_90` is the share of them inside the central 90 % of the quantiles,
    `crossing` the share of neighbouring quantiles in the wrong order, `bias` and `rmse` those of the mean, `spread` the mean standard
    deviation of the quantiles, `crps` the continuous ranked probability score, `pit` the share of returns in each of `BINS` equal
    parts of probability, `similar_means` the shares of steps whose target and prediction have similar means for their shapes
    (`similar`). Raises as `outcomes.play`, `restore.trained` and `restore.reward_std`.
    """
    found = restore.trained(source, config, which)
    policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
    std = float(restore.reward_std(found.path, config)[index])
    came = outcomes.play(policy, config, jax.random.key(seed), WORLDS, watch)
    quantiles = jax.jit(make_quantiles(make_task(config), config))(critic, came.obs)
    about = {"checkpoint": found.path.name, "samples": came.outcome.size}
    similar_means = similar(came.reward / std, came.discount, quantiles)
    return {**about, **statistics(quantiles, came.outcome / std), "similar_means": similar_means}


def statistics(quantiles: jax.Array, outcome: jax.Array) -> dict[str, Any]:
    """Of quantiles [T, N, K] and the returns [T, N] that came."""
    error, probability = (
        np.asarray(quantiles.mean(-1) - outcome),
        np.asarray(pit(quantiles, outcome)),
    )
    falls = jnp.diff(quantiles) < 0
    found = {
        "coverage_90": coverage(quantiles, outcome, 0.9),
        "crossing": falls.mean() if falls.size else 0.0,
        "bias": error.mean(),
        "rmse": np.sqrt((error**2).mean()),
        "spread": quantiles.std(-1).mean(),
        "crps": crps(quantiles, outcome).mean(),
    }
    bins = np.histogram(probability, BINS, (0, 1))[0] / probability.size
    return {
        **{name: round(float(value), 6) for name, value in found.items()},
        "pit": [round(float(share), 6) for share in bins],
    }


def similar(reward: jax.Array, discount: jax.Array, quantiles: jax.Array) -> dict[str, float]:
    """By each of `SHARES`, the share of steps [T − 1, N] with |d(r + γG′, G)| ≤ share · W₁(r + γG′, G) (Sec. results)."""
    before, after = quantiles[:-1], quantiles[1:]
    target = bellman_target(reward[: len(before)], discount[: len(before)], after)
    return {
        str(share): round(float(similar_means(target, before, share).mean()), 6) for share in SHARES
    }
