"""Environments of Brax's own under our trainer, and our tasks under Brax's.

Importing this registers our tasks with Brax as `dgae_ant`, `dgae_hopper`, `dgae_swimmer` and `dgae_walker2d`, for Brax's own
trainers: `brax.envs.get_environment("dgae_hopper", physics="jax")`.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from dgae_jax.envs.base import Env, Wrapper, brax
from dgae_jax.envs.registry import BRAX, TASKS, make_env
from dgae_jax.physics.native import silence_warnings


class BraxTask(Wrapper):
    """An environment of Brax's own, whose actions lie in [−1, 1]."""

    @property
    def action_range(self) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
        """The lowest and highest action."""
        return -jnp.ones(self.action_size), jnp.ones(self.action_size)


def make(name: str, physics: str, version: None, **parameters) -> Env:
    """The environment that Brax calls `name`, on Brax's MJX backend; raises ValueError where Brax cannot build it."""
    try:
        with warnings.catch_warnings(), silence_warnings():
            warnings.simplefilter(
                "ignore"
            )  # Brax speaks of features of its model files that it leaves out
            return BraxTask(brax.envs.get_environment(name, backend=physics, **parameters))
    except (ValueError, TypeError) as reason:
        raise ValueError(
            f"environment {BRAX}{name}: must be one that Brax can build on {physics} ({reason})"
        ) from None


@contextmanager
def trainers() -> Iterator[None]:
    """Brax's trainers (`brax.training.agents`) can be called inside.

    They call `jax.device_put_replicated`, which JAX does not have from 0.10 on (google/brax#671); here it has it again.
    """
    jax.device_put_replicated = _replicated
    try:
        yield
    finally:
        del jax.device_put_replicated


def _replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """A copy on each device, along a new first axis."""
    divided = NamedSharding(Mesh(np.array(devices), ("devices",)), PartitionSpec("devices"))
    return jax.tree.map(lambda x: jax.device_put(jnp.stack([x] * len(devices)), divided), tree)


for _name in TASKS:
    brax.envs.register_environment(f"dgae_{_name}", partial(make_env, _name))  # pyright: ignore[reportArgumentType]
