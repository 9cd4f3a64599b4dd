"""Episodes in parallel worlds: time limits, true successors, fresh resets; for training and for evaluation."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from dgae_jax.envs.base import Env, restart
from dgae_jax.learn.types import Transition

Act = Callable[[Array, Array], tuple[Array, Array]]
"""`act(keys [N], obs [N, O]) -> (action [N, A], log_prob [N])`: what a world draws depends on its own key alone."""


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
    nonfinite: Int[Array, " N"]
    """How often the world has turned non-finite so far."""
    incident: Any
    """`(env state before, action [N, A])` of the last time."""


def start(env: Env, keys: Key[Array, " N"]) -> Episodes:
    """A world per key, at the beginning of an episode each."""
    return _begun(env, jax.vmap(env.reset)(keys))


def _begun(env: Env, state: Any) -> Episodes:
    count = len(state.reward)
    zero, none = jnp.zeros_like(state.reward), jnp.zeros(count, jnp.int32)
    never = jnp.full_like(zero, jnp.nan)
    nothing = state.pipeline_state, jnp.zeros((count, env.action_size), zero.dtype)
    return Episodes(state, none, zero, never, never, none, nothing)


def where(mask: Bool[Array, " N"], yes: Any, no: Any) -> Any:
    """World by world, one of two trees whose arrays begin with the axis of worlds."""
    return jax.tree.map(lambda a, b: jnp.where(_like(mask, b), a, b), yes, no)


def _like(mask: Bool[Array, " N"], x: Array) -> Array:
    return mask.reshape(mask.shape + (1,) * (x.ndim - 1))


def finite(tree: Any) -> Bool[Array, " N"]:
    """Which worlds have only finite numbers."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(x).reshape(x.shape[0], -1).all(1) for x in leaves]).all(0)


def _quarantine(step: Transition, valid: Bool[Array, " N"]) -> Transition:
    """The step with every number finite: an invalid one has action, log-probability and reward 0 and stays where it was."""
    obs = jnp.where(jnp.isfinite(step.obs), step.obs, 0)
    action, log_prob, reward = (jnp.where(_like(valid, x), x, 0) for x in (step.action, step.log_prob, step.reward))
    next_obs = jnp.where(valid[:, None], step.next_obs, obs)
    return step._replace(obs=obs, action=action, log_prob=log_prob, reward=reward, next_obs=next_obs)


def _record(episodes: Episodes, attempt: Any, valid: Bool[Array, " N"]) -> Episodes:
    """Count the invalid steps, and keep the state before and the action of each world's last."""
    return episodes._replace(nonfinite=episodes.nonfinite + ~valid, incident=where(valid, episodes.incident, attempt))


def ends(state: Any, late: Bool[Array, " N"]) -> tuple[Bool[Array, " N"], Bool[Array, " N"]]:
    """Which worlds the task ended, and which were cut short: those that are `late`, and those that the task says are done with
    `truncation` in `info`, as Brax has it.
    """
    done = state.done > 0
    if "truncation" not in state.info:
        return done, late
    cut = done & (state.info["truncation"] > 0)
    return done & ~cut, cut | late


def _advance(episodes: Episodes, after: Any, step: Transition, fresh: Episodes) -> Episodes:
    """The worlds after a step: those whose episode ended begin a fresh one."""
    done = step.terminated | step.truncated
    steps, total = episodes.steps + 1, episodes.total + step.reward
    state, now_steps, now_total = where(done, (fresh.env, fresh.steps, fresh.total), (after, steps, total))
    return episodes._replace(
        env=state,
        steps=now_steps,
        total=now_total,
        last_total=jnp.where(done, total, episodes.last_total),
        last_steps=jnp.where(done, steps, episodes.last_steps),
    )


def rollout(env: Env, act: Act, episodes: Episodes, keys: Key[Array, "T N"], *, episode_length: int) -> tuple[Episodes, Transition]:
    """T steps in every world, each with a key of its own, so that it does not matter how worlds are divided over devices.

    The action is clipped to the actuators' range before it acts, not in the record. The time limit is `episode_length`, or the
    task's own if that comes first. An episode that ends is followed by a fresh random one; `next_obs` stays the observation in which
    it ended. A world whose action, state, reward or observation turns non-finite is quarantined: its episode ends there as terminated
    with reward 0, the step is marked as not `valid`, and only finite numbers leave this function.
    """
    low, high = env.action_range

    def one(episodes: Episodes, keys: Key[Array, " N"]):
        act_keys, reset_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        before = episodes.env
        action, log_prob = act(act_keys, before.obs)
        after = jax.vmap(env.step)(before, jnp.clip(action, low, high))
        valid = finite((before.obs, action, log_prob, after.pipeline_state, after.reward, after.obs, after.done))
        over, cut = ends(after, episodes.steps + 1 >= episode_length)
        terminated = over | ~valid
        truncated = ~terminated & cut
        step = Transition(before.obs, action, log_prob, after.reward, terminated, truncated, after.obs, valid)  # pyright: ignore[reportArgumentType]
        step = _quarantine(step, valid)
        episodes = _record(episodes, (before.pipeline_state, action), valid)
        again = jax.vmap(partial(restart, env))(after, reset_keys, terminated | truncated)
        return _advance(episodes, after, step, _begun(env, again)), step

    return jax.lax.scan(one, episodes, keys)
