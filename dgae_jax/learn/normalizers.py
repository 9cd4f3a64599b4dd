"""Running scales of observations and rewards, frozen while an iteration acts and learns."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics
from jaxtyping import Array, ArrayLike, Bool, Float

OBSERVATION_LIMIT = 10.0
"""Normalised observations are clipped to ±10 deviations."""

Statistics = running_statistics.RunningStatisticsState


class ReturnScale(NamedTuple):
    """The deviation of the discounted return, by which rewards are divided (Engstrom et al. 2020)."""

    discounted: Float[Array, " N"]
    """Discounted return since the episode began, in each world."""
    statistics: Any


def observations(size: int) -> Statistics:
    """Mean 0 and deviation 1 until the first update."""
    return running_statistics.init_state(jnp.zeros(size))


def observe(statistics: Statistics, obs: Float[Array, "T N O"], sound: Bool[Array, "T N"]) -> Statistics:
    """The statistics with a rollout's sound observations in them, for the next iteration."""
    return running_statistics.update(statistics, obs, weights=sound.astype(obs.dtype))


def normalize(statistics: Statistics, obs: Float[Array, "*batch O"]) -> Float[Array, "*batch O"]:
    """(obs − mean) / deviation, clipped."""
    return running_statistics.normalize(obs, statistics, OBSERVATION_LIMIT)


def return_scale(num_envs: int) -> ReturnScale:
    """Scale 1 until the first update."""
    return ReturnScale(jnp.zeros(num_envs), running_statistics.init_state(jnp.zeros(())))


def rescale(
    scale: ReturnScale, reward: Float[Array, "T N"], done: Float[Array, "T N"], gamma: ArrayLike
) -> tuple[ReturnScale, Float[Array, "T N"]]:
    """Follow the discounted returns through a rollout, then divide its rewards by their deviation.

    The policy never sees rewards, so the statistics may include the rollout they scale: the first is scaled too.
    """

    def forward(discounted, step):
        reward, done = step
        discounted = gamma * discounted + reward
        return discounted * (1 - done), discounted

    discounted, trail = jax.lax.scan(forward, scale.discounted, (reward, done))
    statistics = running_statistics.update(scale.statistics, trail)
    return ReturnScale(discounted, statistics), reward / jnp.asarray(statistics.std)
