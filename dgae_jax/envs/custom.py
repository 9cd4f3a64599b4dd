"""Brax's own environments, and custom ones that are given as objects."""

import warnings
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dgae_jax.envs.base import Env, Wrapper, brax
from dgae_jax.envs.env_checker import check_env
from dgae_jax.physics.engine import silence_warnings


class CustomTask(Wrapper):
    """A custom env with the one thing beyond Brax's contract: the range of its actions."""

    @property
    def action_range(self) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
        """The lowest and highest action: the env's own `action_range`, or −1 and 1."""
        own = getattr(self.env, "action_range", (-1.0, 1.0))
        low, high = (jnp.broadcast_to(jnp.asarray(each, float), self.action_size) for each in own)
        return low, high


def with_range(env: Env) -> Env:
    """Return the env, with a range of its actions if it has none."""
    return env if hasattr(env, "action_range") else CustomTask(env)


def make_custom(env: Any) -> CustomTask:
    """Check and wrap an env; raise ValueError if the trainer cannot take it."""
    if not isinstance(env, Env):
        raise ValueError(f"{type(env).__name__} is not a brax.envs.base.Env")
    check_env(env)
    return CustomTask(env)


def make_brax(name: str, physics: str, **parameters) -> Env:
    """Build one of Brax's own environments on its MJX backend, with actions in [−1, 1]."""
    silence_warnings()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of features of the model files that Brax leaves out
            return CustomTask(brax.envs.get_environment(name, backend=physics, **parameters))
    except (KeyError, ValueError, TypeError) as reason:
        raise ValueError(f"Brax cannot build {name} on {physics}: {reason!r}") from None
