"""Memory of a run, estimated before anything is compiled or allocated.

Counted are the arrays that exist at the same time: the training state before and after, one rollout
with what is computed from it, and the activations of a gradient step. XLA's own buffers come on
top, so that a run that is refused would not have fitted.
"""

from itertools import pairwise
from typing import Any

import jax

from dgae_jax.configs.config import invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.envs.base import Env

SMALL: dict[str, Any] = {
    "num_seeds": 1,
    "num_envs": 16,
    "num_steps": 128,
    "policy.hidden": (64, 64),
    "critic.hidden": (64, 64),
    "critic.quantiles": 64,
}
"""The settings that memory grows with, at values that fit everywhere."""

FLOAT = 4
"""Bytes of a float32."""


def needed(config: ResolvedConfig, env: Env) -> int:
    """Return the bytes that a run takes at least."""
    obs, actions = int(env.observation_size), env.action_size  # pyright: ignore
    state = jax.tree.leaves(jax.eval_shape(env.reset, jax.random.key(0)))
    env_bytes = sum(x.size * x.dtype.itemsize for x in state)
    samples, outputs = config.samples_per_iteration, config.critic.outputs
    # transitions, the batch made of them, predictions
    rollout = FLOAT * samples * (4 * obs + 2 * actions + 3 * outputs + 16)
    per_critic_step = samples // config.critic.fit["minibatches"]
    per_policy_step = samples // config.policy.options.get("minibatches", 1)
    networks = _network((obs, *config.policy.hidden, actions), per_policy_step)
    networks += _network((obs, *config.critic.hidden, outputs), per_critic_step)
    # a CPU computes the residuals of one target at a time (`maths.transport`)
    one_target = config.critic.target == "lambda-return" or jax.default_backend() == "cpu"
    residuals = FLOAT * outputs * (1 if one_target else outputs) * per_critic_step
    return config.num_seeds * (2 * env_bytes * config.num_envs + rollout + networks + residuals)


def _network(widths: tuple[int, ...], samples: int) -> int:
    """Bytes of parameters with Adam's moments, before and after, and of activations."""
    weights = sum((a + 1) * b for a, b in pairwise(widths))
    return FLOAT * (6 * weights + 2 * sum(widths) * samples)


def check_memory(config: ResolvedConfig, env: Env, available: int) -> None:
    """Raise ConfigError, naming the setting that matters most, if a run needs more bytes."""
    total = needed(config, env)
    if total <= available:
        return
    written = config.as_config()

    def smaller(setting: str) -> int:
        # a budget and minibatches that fit any rollout, so that only the setting decides
        changed = {setting: SMALL[setting], "total_steps": 2**31 - 1}
        return needed(resolve(written.replace(**changed)), env)

    used = [name for name in SMALL if written.get(name) is not None]
    setting = min(used, key=smaller)
    gib = f"{total / 2**30:,.1f} GiB of memory, and there are {available / 2**30:,.1f} GiB"
    raise invalid(setting, written.get(setting), f"smaller: the run needs at least {gib}")
