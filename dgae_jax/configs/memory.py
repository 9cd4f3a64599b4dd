"""How much memory a run takes, estimated before anything is compiled or allocated.

Counted are the arrays that must exist at the same time: the training state twice (as it was and as it becomes), one rollout with
what is computed from it, and the activations of one gradient step. XLA's own buffers come on top, so that a run that is refused
would not have fitted.
"""

import dataclasses
from itertools import pairwise
from typing import Any

import jax

from dgae_jax.configs.config import Config, invalid
from dgae_jax.envs.base import Env

USUAL: dict[str, Any] = {
    "num_seeds": 1, "num_envs": 16, "horizon": 128, "policy.hidden": (64, 64), "critic.hidden": (64, 64), "critic.quantiles": 64,
}  # fmt: skip
"""The settings that memory grows with, at values that fit everywhere."""

FLOAT = 4
"""Bytes of a float32."""


def needed(config: Config, env: Env) -> int:
    """Bytes that a run of a resolved configuration takes at least."""
    obs, actions = int(env.observation_size), env.action_size  # pyright: ignore[reportArgumentType]
    world = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(env.reset, jax.random.key(0))))
    samples, outputs = config.samples_per_iteration, config.critic.quantiles or 1
    rollout = FLOAT * samples * (4 * obs + 2 * actions + 3 * outputs + 16)  # transitions, the batch made of them, predictions
    networks = _network((obs, *config.policy.hidden, actions), samples, config.policy.minibatches)
    networks += _network((obs, *config.critic.hidden, outputs), samples, config.critic.minibatches)
    at_once = 1 if config.critic.target == "lambda-return" or jax.default_backend() == "cpu" else outputs  # targets, `maths.transport`
    residuals = FLOAT * outputs * at_once * (samples // (config.critic.minibatches or 1))
    return config.num_seeds * (2 * world * config.num_envs + rollout + networks + residuals)


def _network(widths: tuple[int, ...], samples: int, minibatches: int | None) -> int:
    """Parameters with Adam's two moments, before and after, and what a gradient step keeps of every layer."""
    weights = sum((a + 1) * b for a, b in pairwise(widths))
    return FLOAT * (6 * weights + 2 * sum(widths) * (samples // (minibatches or 1)))


def check_memory(config: Config, env: Env, available: int) -> None:
    """Raise ConfigError, naming the setting that matters most, for a run that needs more than `available` bytes."""
    total = needed(config, env)
    if total > available:
        setting = min(USUAL, key=lambda name: needed(_with(config, name, USUAL[name]), env))
        reason = f"smaller: the run needs at least {total / 2**30:,.1f} GiB of memory, and there are {available / 2**30:,.1f} GiB"
        raise invalid(setting, _get(config, setting), reason)


def _get(config: Config, path: str) -> Any:
    part, _, name = path.rpartition(".")
    return getattr(getattr(config, part) if part else config, name)


def _with(config: Config, path: str, value: Any) -> Config:
    part, _, name = path.rpartition(".")
    changed = {part: dataclasses.replace(getattr(config, part), **{name: value})} if part else {name: value}
    return dataclasses.replace(config, **changed)
