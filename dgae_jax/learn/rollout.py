"""Rollouts in parallel envs: time limits, true successors, fresh resets, masks."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from dgae_jax.envs.base import Env, restart
from dgae_jax.learn.types import Transition

Act = Callable[[Array, Array], tuple[Array, Array]]
"""`act(keys [N], obs [N, O]) -> (action [N, A], log_prob [N])`; each env has a key of its own."""


class Episodes(NamedTuple):
    """The envs, and the episode that each of them is in."""

    env: Any
    steps: Int[Array, " N"]
    total: Float[Array, " N"]
    """Undiscounted return so far."""
    last_total: Float[Array, " N"]
    """Undiscounted return of the last finished episode; NaN before the first."""
    last_steps: Float[Array, " N"]
    """Its length; NaN before the first."""
    nonfinite: Int[Array, " N"]
    """Number of masked steps so far."""
    incident: Any
    """`(env state before, action [N, A])` of the last masked step."""


def start(env: Env, keys: Key[Array, " N"]) -> Episodes:
    """Return an env per key, each at the beginning of an episode."""
    return _begin(env, jax.vmap(env.reset)(keys))


def _begin(env: Env, state: Any) -> Episodes:
    count = len(state.reward)
    zeros, counts = jnp.zeros_like(state.reward), jnp.zeros(count, jnp.int32)
    never = jnp.full_like(zeros, jnp.nan)
    incident = state.pipeline_state, jnp.zeros((count, env.action_size), zeros.dtype)
    return Episodes(state, counts, zeros, never, never, counts, incident)


def where(mask: Bool[Array, " N"], yes: Any, no: Any) -> Any:
    """Select one of two trees per env; their arrays have a leading axis of envs."""
    return jax.tree.map(lambda a, b: jnp.where(_like(mask, b), a, b), yes, no)


def _like(mask: Bool[Array, " N"], x: Array) -> Array:
    return mask.reshape(mask.shape + (1,) * (x.ndim - 1))


def finite(tree: Any) -> Bool[Array, " N"]:
    """Return which envs have only finite numbers."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(x).reshape(x.shape[0], -1).all(1) for x in leaves]).all(0)


def _masked(step: Transition) -> Transition:
    """Make every number finite: a masked step has no action or reward and stays where it was."""
    obs = jnp.where(jnp.isfinite(step.obs), step.obs, 0)
    numbers = {name: getattr(step, name) for name in ("action", "log_prob", "reward")}
    kept = {name: jnp.where(_like(step.mask, x), x, 0) for name, x in numbers.items()}
    next_obs = jnp.where(step.mask[:, None], step.next_obs, obs)
    return step._replace(obs=obs, next_obs=next_obs, **kept)


def ends(state: Any, late: Bool[Array, " N"]) -> tuple[Bool[Array, " N"], Bool[Array, " N"]]:
    """Return which episodes terminated, and which were truncated.

    An episode is truncated at the time limit (`late`), or where the task is done with
    `info["truncation"]`, as in Brax.
    """
    done = state.done > 0
    if "truncation" not in state.info:
        return done, late
    cut = done & (state.info["truncation"] > 0)
    return done & ~cut, cut | late


def _advance(episodes: Episodes, after: Any, step: Transition, fresh: Episodes) -> Episodes:
    """Return the envs after a step; where the episode ended, a fresh one begins."""
    done = step.terminated | step.truncated
    steps, total = episodes.steps + 1, episodes.total + step.reward
    anew = fresh.env, fresh.steps, fresh.total
    state, now_steps, now_total = where(done, anew, (after, steps, total))
    return episodes._replace(
        env=state,
        steps=now_steps,
        total=now_total,
        last_total=jnp.where(done, total, episodes.last_total),
        last_steps=jnp.where(done, steps, episodes.last_steps),
    )


def rollout(
    env: Env, act: Act, episodes: Episodes, keys: Key[Array, "T N"], *, episode_length: int
) -> tuple[Episodes, Transition]:
    """Take T steps in every env.

    A finished episode is followed by a fresh random one; `next_obs` stays the observation in which
    it ended. Where an action, state, reward or observation turns non-finite, the step is masked and
    the episode ends as terminated with reward 0: the transitions hold only finite numbers.

    Args:
        env: the task.
        act: samples actions, which are clipped to the actuators' range before they act.
        episodes: the envs at the start.
        keys: one per step and env, so that results do not depend on the devices that share envs.
        episode_length: time limit; a shorter limit of the task itself comes first.

    Returns:
        The envs at the end, and the transitions [T, N].
    """
    low, high = env.action_range

    def one(episodes: Episodes, keys: Key[Array, " N"]):
        act_keys, reset_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        before: Any = episodes.env
        action, log_prob = act(act_keys, before.obs)
        after: Any = jax.vmap(env.step)(before, jnp.clip(action, low, high))
        numbers = before.obs, action, log_prob, after.pipeline_state, after.reward, after.obs
        mask = finite((*numbers, after.done))
        over, cut = ends(after, episodes.steps + 1 >= episode_length)
        terminated = over | ~mask
        truncated = ~terminated & cut
        step = Transition(
            before.obs, action, log_prob, after.reward, terminated, truncated, after.obs, mask
        )
        step = _masked(step)
        incident = where(mask, episodes.incident, (before.pipeline_state, action))
        episodes = episodes._replace(nonfinite=episodes.nonfinite + ~mask, incident=incident)
        again = jax.vmap(partial(restart, env))(after, reset_keys, terminated | truncated)
        return _advance(episodes, after, step, _begin(env, again)), step

    return jax.lax.scan(one, episodes, keys)
