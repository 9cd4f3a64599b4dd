"""How much memory a run takes, estimated before anything is compiled or allocated.

Counted are the arrays that must exist at the same time, in bytes: the training state twice (as it was and as it becomes), one
rollout with what is computed from it, and the activations of one gradient step. XLA's own buffers come on top, so that a run
that is refused would not have fitted.
"""

from itertools import pairwise

import jax
from brax.envs.base import Env

from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.configs.validation import validate

BYTES = 4
"""Of a float32."""


def needs(config: Config, env: Env) -> dict[str, int]:
    """Bytes by the setting that they grow with, over all seeds."""
    config, obs, actions = validate(config), int(env.observation_size), env.action_size  # pyright: ignore[reportArgumentType]
    world = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(env.reset, jax.random.key(0))))
    samples, outputs = config.samples_per_iteration, config.critic.quantiles or 1
    networks = {"policy": (obs, *config.policy.hidden, actions), "critic": (obs, *config.critic.hidden, outputs)}
    one = {
        "num_envs": 2 * world * config.num_envs + BYTES * samples * 2 * (2 * obs + actions + 8),
        "critic.quantiles": BYTES * (3 * samples * outputs + _rows(config, "critic") * outputs**2),
    }
    for part, widths in networks.items():
        weights = sum((a + 1) * b for a, b in pairwise(widths))
        activations = max(2 * _rows(config, part) * sum(widths), 2 * samples * max(widths))
        one[f"{part}.hidden"] = BYTES * (6 * weights + activations)  # parameters and two moments, before and after
    return {setting: config.num_seeds * size for setting, size in one.items()}


def _rows(config: Config, part: str) -> int:
    """Samples in one gradient step of a network."""
    settings = getattr(config, part)
    return config.samples_per_iteration // settings.minibatches if settings.minibatches else config.samples_per_iteration


def check_memory(config: Config, env: Env, available: int) -> None:
    """Raise ConfigError, naming the setting that takes most and both numbers, for a run that needs more than `available` bytes."""
    each = needs(config, env)
    total = sum(each.values())
    if total > available:
        setting = max(each, key=lambda name: each[name])
        value = _shown(config, setting)
        raise ConfigError(
            f"{setting} {value}: must be such that the run fits: it needs at least {_gib(total)}, {_gib(each[setting])} of it for this;"
            f" there are {_gib(available)}",
            setting,
        )


def _shown(config: Config, setting: str) -> str:
    part, _, name = setting.rpartition(".")
    value = getattr(getattr(validate(config), part) if part else config, name)
    return " ".join(map(str, value)) if isinstance(value, tuple) else f"{value}"


def _gib(size: int) -> str:
    return f"{size / 2**30:,.1f} GiB"
