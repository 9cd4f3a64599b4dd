"""Running statistics of observations and rewards.

Those of observations are frozen while an iteration acts and learns; rewards are scaled with their
rollout included.

Samples are bounded on their way into the statistics: none may count for more than all samples
before it together, (x − mean)² ≤ Σ (xⱼ − mean)². One outlier then at most doubles a variance, and
further samples dilute it. Data of finite variance are not affected, because the largest of n
samples grows more slowly than √n. A scale that really grows is followed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics
from jaxtyping import Array, ArrayLike, Bool, Float

OBSERVATION_LIMIT = 10.0
"""Normalized observations are clipped to ±10 standard deviations."""

MAX_EXTREMES = 20
"""Most values left out at either end of the first rollout, so that finding them is cheap."""

Statistics = running_statistics.RunningStatisticsState
Observations = Float[Array, "*batch O"]
Rollout = Float[Array, "T N *F"]
Mask = Bool[Array, "T N"]


class RewardScale(NamedTuple):
    """The standard deviation of the discounted return divides rewards (Engstrom et al. 2020)."""

    discounted: Float[Array, " N"]
    """Discounted return since the episode began, in each env."""
    returns: Statistics
    """Statistics of the discounted returns."""
    rewards: Statistics
    """Statistics of the rewards, which bound them."""


def init_obs_stats(size: int) -> Statistics:
    """Return statistics with mean 0 and standard deviation 1."""
    return running_statistics.init_state(jnp.zeros(size))


def update_obs_stats(statistics: Statistics, obs: Rollout, mask: Mask) -> Statistics:
    """Return the statistics with the unmasked observations of a rollout, for the next iteration."""
    return _update(statistics, _bounded(statistics, obs), mask)


def normalize(statistics: Statistics | None, obs: Observations) -> Observations:
    """Return (obs − mean) / standard deviation, clipped; `obs` itself without statistics."""
    if statistics is None:
        return obs
    return running_statistics.normalize(obs, statistics, OBSERVATION_LIMIT)


def init_reward_scale(num_envs: int) -> RewardScale:
    """Return a scale of 1."""
    returns, rewards = (running_statistics.init_state(jnp.zeros(())) for _ in range(2))
    return RewardScale(jnp.zeros(num_envs), returns, rewards)


def scale_rewards(
    scale: RewardScale,
    reward: Float[Array, "T N"],
    done: Float[Array, "T N"],
    mask: Mask,
    gamma: ArrayLike,
) -> tuple[RewardScale, Float[Array, "T N"]]:
    """Update the scale with a rollout and divide the rollout's rewards by it.

    The policy never sees rewards, so the statistics may include the rollout they scale. Rewards are
    bounded in the statistics only; those that are returned are divided and not clipped.
    """

    def forward(discounted, step):
        reward, done = step
        discounted = gamma * discounted + reward
        return discounted * (1 - done), discounted

    bounded = _bounded(scale.rewards, reward)
    discounted, discounted_returns = jax.lax.scan(forward, scale.discounted, (bounded, done))
    returns = _update(scale.returns, discounted_returns, mask)
    updated = RewardScale(discounted, returns, _update(scale.rewards, bounded, mask))
    return updated, reward / jnp.asarray(returns.std)


def _update(statistics: Statistics, rollout: Rollout, mask: Mask) -> Statistics:
    return running_statistics.update(statistics, rollout, weights=mask.astype(rollout.dtype))


def _bounded(statistics: Statistics, rollout: Rollout) -> Rollout:
    """Clip each sample to the mean ± the root of the sum of squares of all earlier samples.

    Where that sum is 0 (no samples, or equal ones) the rollout without its lowest and highest
    hundredth takes their place; where that is constant too, there is no bound.
    """
    mean, squares = (jnp.asarray(x) for x in (statistics.mean, statistics.summed_variance))

    def from_rollout():
        samples = jnp.moveaxis(rollout.reshape(-1, *mean.shape), 0, -1)
        count = samples.shape[-1]
        extremes = min(-(-count // 100), (count - 1) // 2, MAX_EXTREMES)
        highest, lowest = (
            jax.lax.top_k(x, extremes + 1)[0].min(-1)  # indexing the last would sort all
            for x in (samples, -samples)
        )
        usual = (-lowest <= rollout) & (rollout <= highest)
        center = rollout.mean((0, 1), where=usual)
        return center, ((rollout - center) ** 2).sum((0, 1), where=usual)

    first = jax.lax.cond((squares > 0).all(), lambda: (mean, squares), from_rollout)
    mean, squares = (jnp.where(squares > 0, *x) for x in zip((mean, squares), first, strict=True))
    limit = jnp.where(squares > 0, jnp.sqrt(squares), jnp.inf)
    return jnp.clip(rollout, mean - limit, mean + limit)
