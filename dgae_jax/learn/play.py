"""Episodes that are only watched: independent envs, each until its first end."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from dgae_jax.envs.base import Env


class Play(NamedTuple):
    """The progress of E episodes."""

    env: Any
    total: Float[Array, " E"]
    """Undiscounted return so far; final where the episode has ended."""
    alive: Bool[Array, " E"]
    """False where the episode has ended."""
    step: Int[Array, ""]


def begin(state: Any) -> Play:
    """Return the episodes that begin in these env states, which have a leading axis."""
    zeros = jnp.zeros_like(state.reward)
    return Play(state, zeros, jnp.full(zeros.shape, True), jnp.int32(0))


def play(env: Env, act: Callable[[Array], Array], episodes: Play, until: ArrayLike) -> Play:
    """Continue to step number `until`, or until all episodes have ended.

    Args:
        env: the task.
        act: `act(obs [E, O]) -> action [E, A]`, clipped to the actuators' range.
        episodes: where they are.
        until: the step to stop at.
    """
    low, high = env.action_range

    def unfinished(episodes: Play):
        return episodes.alive.any() & (episodes.step < until)

    def one(episodes: Play) -> Play:
        state = jax.vmap(env.step)(episodes.env, jnp.clip(act(episodes.env.obs), low, high))
        total = episodes.total + jnp.where(episodes.alive, state.reward, 0)
        return Play(state, total, episodes.alive & (state.done == 0), episodes.step + 1)

    return jax.lax.while_loop(unfinished, one, episodes)
