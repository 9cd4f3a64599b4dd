"""Our tasks under Brax's trainers.

Importing this registers them with Brax as `dgae_ant`, `dgae_hopper`, `dgae_swimmer` and
`dgae_walker2d`: `brax.envs.get_environment("dgae_hopper", physics="jax")`.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dgae_jax.envs.base import brax
from dgae_jax.envs.registry import TASKS, make_env


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
    copies = jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)
    return jax.device_put(copies, sharding)


for _name in TASKS:
    brax.envs.register_environment(f"dgae_{_name}", partial(make_env, _name))  # pyright: ignore
