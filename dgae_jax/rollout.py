"""Episodes in parallel worlds: time limits, true successors, fresh resets; for training and for evaluation."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.envs.base import Env
from jaxtyping import Array, Bool, Float, Int, Key

from dgae_jax.types import Transition

Act = Callable[[Array, Array], tuple[Array, Array]]
"""`act(key, obs [N, O]) -> (action [N, A], log_prob [N])`."""


class Episodes(NamedTuple):
    """The worlds, and the episode each of them is in."""

    env: Any
    steps: Int[Array, " N"]
    total: Float[Array, " N"]
    """Undiscounted return so far."""
    last_total: Float[Array, " N"]
    """Undiscounted return of the last episode that ended in this world; NaN before the first."""
    last_steps: Float[Array, " N"]
    """Its length; NaN before the first."""


def start(env: Env, key: Key[Array, ""], num_envs: int) -> Episodes:
    """`num_envs` worlds at the beginning of an episode each."""
    state = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    zero = jnp.zeros_like(state.reward)
    never = jnp.full_like(zero, jnp.nan)
    return Episodes(state, jnp.zeros(num_envs, jnp.int32), zero, never, never)


def _where(mask: Bool[Array, " N"], yes: Any, no: Any) -> Any:
    def pick(a, b):
        return jnp.where(mask.reshape(mask.shape + (1,) * (b.ndim - 1)), a, b)

    return jax.tree.map(pick, yes, no)


def rollout(
    env: Env, act: Act, episodes: Episodes, key: Key[Array, ""], *, horizon: int, episode_length: int
) -> tuple[Episodes, Transition]:
    """`horizon` steps in every world. The action is clipped to the actuators' range before it acts, not in the record.

    An episode that ends is followed by a fresh random one; `next_obs` stays the observation in which it ended.
    """
    low, high = env.action_range

    def one(episodes: Episodes, key: Key[Array, ""]):
        act_key, reset_key = jax.random.split(key)
        action, log_prob = act(act_key, episodes.env.obs)
        after = jax.vmap(env.step)(episodes.env, jnp.clip(action, low, high))
        steps, total = episodes.steps + 1, episodes.total + after.reward
        terminated = after.done > 0
        truncated = ~terminated & (steps >= episode_length)
        done = terminated | truncated
        fresh = start(env, reset_key, steps.shape[0])
        ended = fresh._replace(last_total=total, last_steps=steps.astype(total.dtype))
        going = Episodes(after, steps, total, episodes.last_total, episodes.last_steps)
        step = Transition(episodes.env.obs, action, log_prob, after.reward, terminated, truncated, after.obs)  # pyright: ignore[reportArgumentType]
        return _where(done, ended, going), step

    return jax.lax.scan(one, episodes, jax.random.split(key, horizon))


def evaluate(env: Env, act: Callable[[Array], Array], key: Key[Array, ""], *, episodes: int, episode_length: int) -> Float[Array, " E"]:
    """Undiscounted returns of `act(obs [E, O]) -> action [E, A]` in independent episodes, side by side until all end."""
    low, high = env.action_range

    def going(carry):
        _, _, alive, step = carry
        return alive.any() & (step < episode_length)

    def one(carry):
        state, total, alive, step = carry
        state = jax.vmap(env.step)(state, jnp.clip(act(state.obs), low, high))
        total = total + jnp.where(alive, state.reward, 0)
        return state, total, alive & (state.done == 0), step + 1

    state = jax.vmap(env.reset)(jax.random.split(key, episodes))
    carry = (state, jnp.zeros_like(state.reward), jnp.full(episodes, True), jnp.int32(0))
    return jax.lax.while_loop(going, one, carry)[1]
