"""Running scales of observations and rewards, frozen while an iteration acts and learns.

What enters them is bounded: no sample counts for more than all samples before it together, (x − mean)² ≤ Σ (xⱼ − mean)². One
outlier can then at most double a variance, and further samples dilute it. Data of finite variance are not affected, because their
largest of n samples grows more slowly than √n; a scale that really grows is followed, because every sample may add as much.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics
from jaxtyping import Array, ArrayLike, Bool, Float

OBSERVATION_LIMIT = 10.0
"""Normalised observations are clipped to ±10 standard deviations."""

MOST_EXTREMES = 20
"""Most values at either end of the first rollout that are not taken for usual, which keeps finding them cheap."""

Statistics = running_statistics.RunningStatisticsState


class RewardScale(NamedTuple):
    """The standard deviation of the discounted return, by which rewards are divided (Engstrom et al. 2020)."""

    discounted: Float[Array, " N"]
    """Discounted return since the episode began, in each world."""
    returns: Statistics
    """Of the discounted returns."""
    rewards: Statistics
    """Of the rewards, by which one of them is judged out of proportion."""


def observations(size: int) -> Statistics:
    """Mean 0 and standard deviation 1 until the first update."""
    return running_statistics.init_state(jnp.zeros(size))


def observe(statistics: Statistics, obs: Float[Array, "T N O"], valid: Bool[Array, "T N"]) -> Statistics:
    """The statistics with a rollout's valid observations in them, for the next iteration."""
    return _update(statistics, _bounded(statistics, obs), valid)


def normalize(statistics: Statistics | None, obs: Float[Array, "*batch O"]) -> Float[Array, "*batch O"]:
    """(obs − mean) / standard deviation, clipped to ±10; without statistics, the observation as it is."""
    return obs if statistics is None else running_statistics.normalize(obs, statistics, OBSERVATION_LIMIT)


def reward_scale(num_envs: int) -> RewardScale:
    """Scale 1 until the first update."""
    return RewardScale(jnp.zeros(num_envs), *(running_statistics.init_state(jnp.zeros(())) for _ in range(2)))


def rescale(
    scale: RewardScale, reward: Float[Array, "T N"], done: Float[Array, "T N"], valid: Bool[Array, "T N"], gamma: ArrayLike
) -> tuple[RewardScale, Float[Array, "T N"]]:
    """Follow the discounted returns through a rollout, then divide its rewards by their standard deviation.

    The policy never sees rewards, so the statistics may include the rollout they scale: the first is scaled too. Rewards are
    bounded on their way into the statistics only; those that are returned are all of them, divided and not clipped.
    """

    def forward(discounted, step):
        reward, done = step
        discounted = gamma * discounted + reward
        return discounted * (1 - done), discounted

    bounded = _bounded(scale.rewards, reward)
    discounted, trail = jax.lax.scan(forward, scale.discounted, (bounded, done))
    returns = _update(scale.returns, trail, valid)
    return RewardScale(discounted, returns, _update(scale.rewards, bounded, valid)), reward / jnp.asarray(returns.std)


def _update(statistics: Statistics, rollout: Float[Array, "T N *F"], valid: Bool[Array, "T N"]) -> Statistics:
    return running_statistics.update(statistics, rollout, weights=valid.astype(rollout.dtype))


def _bounded(statistics: Statistics, rollout: Float[Array, "T N *F"]) -> Float[Array, "T N *F"]:
    """Each sample at most as far from the mean as the root of the sum of squares of all before this rollout.

    Where that sum is 0 (nothing was seen, or equal values only) the rollout itself, without its lowest and its highest hundredth,
    stands for what was seen; where that has equal values only too, there is no bound.
    """
    mean, squares = (jnp.asarray(x) for x in (statistics.mean, statistics.summed_variance))

    def of_the_rollout():
        samples = jnp.moveaxis(rollout.reshape(-1, *mean.shape), 0, -1)
        count = samples.shape[-1]
        extremes = min(-(-count // 100), (count - 1) // 2, MOST_EXTREMES)
        highest, lowest = (jax.lax.top_k(x, extremes + 1)[0].min(-1) for x in (samples, -samples))  # the last by index would sort all
        usual = (-lowest <= rollout) & (rollout <= highest)
        centre = rollout.mean((0, 1), where=usual)
        return centre, ((rollout - centre) ** 2).sum((0, 1), where=usual)

    first_mean, first_squares = jax.lax.cond((squares > 0).all(), lambda: (mean, squares), of_the_rollout)
    mean, squares = (jnp.where(squares > 0, *pair) for pair in ((mean, first_mean), (squares, first_squares)))
    reach = jnp.where(squares > 0, jnp.sqrt(squares), jnp.inf)
    return jnp.clip(rollout, mean - reach, mean + reach)
