"""Worlds as Gymnasium's vector environments keep them: an action in, an observation out, and a fresh episode where one ended.

What a `VectorEnv` may do with an ended episode is a row of `MODES`. Everything here is pure and is compiled for all worlds at once.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from dgae_jax.envs.base import Env
from dgae_jax.learn.rollout import ends, finite, where


class Worlds(NamedTuple):
    """The worlds, and the episode each of them is in."""

    state: Any
    """The environment's, its arrays with a leading axis N."""
    steps: Int[Array, " N"]
    """Of the episode so far."""
    over: Bool[Array, " N"]
    """Where the episode has ended and no other has begun."""
    keys: Key[Array, " N"]
    """Where the next reset of each world comes from: it does not matter what other worlds do, or when."""


class Step(NamedTuple):
    """What a step showed, before any reset."""

    obs: Float[Array, "N O"]
    """The true successor, also where the episode ended."""
    reward: Float[Array, " N"]
    terminated: Bool[Array, " N"]
    truncated: Bool[Array, " N"]
    infos: dict[str, Array]
    """The task's metrics [N], and `nonfinite`: where action or simulation was not finite."""


Advance = Callable[[Env, int, Worlds, Array], tuple[Worlds, Step]]
"""`advance(env, limit, worlds, action [N, A]) -> (worlds, step)`, with the time limit in steps."""


def keys_of(seeds: list[int]) -> Key[Array, " N"]:
    """A key for each seed, any integer that is not negative; raises ValueError for others."""
    numbers = [np.random.SeedSequence(seed).generate_state(2) for seed in seeds]
    return jax.random.wrap_key_data(jnp.asarray(np.stack(numbers)), impl="threefry2x32")


def blank(env: Env, keys: Key[Array, " N"]) -> Worlds:
    """A world per key, all zeros, to be renewed."""
    worlds = jax.eval_shape(lambda: _fresh(env, keys))._replace(keys=None)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), worlds)._replace(keys=keys)


def renew(env: Env, worlds: Worlds, mask: Bool[Array, " N"]) -> Worlds:
    """The worlds in `mask` begin a fresh episode, each from its own key."""
    return where(mask, _fresh(env, worlds.keys), worlds)


def _fresh(env: Env, keys: Key[Array, " N"]) -> Worlds:
    reset, rest = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
    count = len(keys)
    return Worlds(
        jax.vmap(env.reset)(reset), jnp.zeros(count, jnp.int32), jnp.full(count, False), rest
    )


def disabled(
    env: Env, limit: int, worlds: Worlds, action: Float[Array, "N A"]
) -> tuple[Worlds, Step]:
    """One step in every world; a world whose episode ends stays there.

    A world that turns non-finite ends its episode as terminated with reward 0 and shows the observation before, as in training.
    """
    before, after = worlds.state, jax.vmap(env.step)(worlds.state, action)
    valid = finite((action, after.pipeline_state, after.reward, after.obs, after.done))
    stays = before.obs, *jax.tree.map(jnp.zeros_like, (after.reward, after.metrics))
    obs, reward, metrics = where(valid, (after.obs, after.reward, after.metrics), stays)
    steps = worlds.steps + 1
    over, truncated = ends(after, steps >= limit)
    terminated = over | ~valid
    moved = worlds._replace(state=after.replace(obs=obs), steps=steps, over=terminated | truncated)
    return moved, Step(obs, reward, terminated, truncated, {**metrics, "nonfinite": ~valid})


def same_step(
    env: Env, limit: int, worlds: Worlds, action: Float[Array, "N A"]
) -> tuple[Worlds, Step]:
    """A world whose episode ends is at the beginning of the next one after the same step."""
    moved, step = disabled(env, limit, worlds, action)
    return renew(env, moved, moved.over), step


def next_step(
    env: Env, limit: int, worlds: Worlds, action: Float[Array, "N A"]
) -> tuple[Worlds, Step]:
    """A world whose episode has ended begins the next one instead of a step, whatever its action; that step shows zeros."""
    moved, step = disabled(env, limit, worlds, action)
    return where(worlds.over, renew(env, worlds, worlds.over), moved), where(
        worlds.over, jax.tree.map(jnp.zeros_like, step), step
    )


MODES: dict[str, Advance] = {"NextStep": next_step, "SameStep": same_step, "Disabled": disabled}
"""By the values of Gymnasium's `AutoresetMode`."""
