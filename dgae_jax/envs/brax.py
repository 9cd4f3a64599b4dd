"""Brax's own environments under our trainer, and our tasks under Brax's.

Importing this registers our tasks with Brax as `dgae_ant`, `dgae_hopper`, `dgae_swimmer` and
`dgae_walker2d`: `brax.envs.get_environment("dgae_hopper", physics="jax")`.
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

from dgae_jax.envs.base import Env, brax
from dgae_jax.envs.custom import CustomTask
from dgae_jax.envs.registry import BRAX, TASKS, make_env
from dgae_jax.physics.native import silence_warnings


def make_brax(name: str, physics: str, **parameters) -> Env:
    """Build one of Brax's own environments on its MJX backend, with actions in [−1, 1].

    Raises:
        ValueError: if Brax cannot build it.
    """
    try:
        with warnings.catch_warnings(), silence_warnings():
            warnings.simplefilter("ignore")  # of features of the model files that Brax leaves out
            return CustomTask(brax.envs.get_environment(name, backend=physics, **parameters))
    except (ValueError, TypeError) as reason:
        raise ValueError(
            f"environment {BRAX}{name}: must be one that Brax can build on {physics} ({reason})"
        ) from None


@contextmanager
def trainers() -> Iterator[None]:
    """Make Brax's trainers (`brax.training.agents`) callable.

    They call `jax.device_put_replicated`, which JAX 0.10 removed (google/brax#671).
    """
    jax.device_put_replicated = _replicated
    try:
        yield
    finally:
        del jax.device_put_replicated


def _replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Return a copy on each device, along a new first axis."""
    sharding = NamedSharding(Mesh(np.array(devices), ("devices",)), PartitionSpec("devices"))
    return jax.tree.map(lambda x: jax.device_put(jnp.stack([x] * len(devices)), sharding), tree)


for _name in TASKS:
    brax.envs.register_environment(f"dgae_{_name}", partial(make_env, _name))  # pyright: ignore[reportArgumentType]
