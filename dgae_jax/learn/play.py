"""Episodes that are only watched: independent worlds side by side, until each one's first end."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from dgae_jax.envs.base import Env


class Play(NamedTuple):
    """Where E episodes are."""

    env: Any
    total: Float[Array, " E"]
    """Undiscounted return so far, of an episode that is over its return."""
    alive: Bool[Array, " E"]
    """False where the episode is over."""
    step: Int[Array, ""]


def begin(state: Any) -> Play:
    """The episodes that begin in these worlds, environment states with a leading axis."""
    return Play(state, jnp.zeros_like(state.reward), jnp.full(state.reward.shape, True), jnp.int32(0))


def play(env: Env, act: Callable[[Array], Array], episodes: Play, until: ArrayLike) -> Play:
    """Go on to step number `until`, or to where all are over, with `act(obs [E, O]) -> action [E, A]`."""
    low, high = env.action_range

    def unfinished(episodes: Play):
        return episodes.alive.any() & (episodes.step < until)

    def one(episodes: Play) -> Play:
        state = jax.vmap(env.step)(episodes.env, jnp.clip(act(episodes.env.obs), low, high))
        total = episodes.total + jnp.where(episodes.alive, state.reward, 0)
        return Play(state, total, episodes.alive & (state.done == 0), episodes.step + 1)

    return jax.lax.while_loop(unfinished, one, episodes)
