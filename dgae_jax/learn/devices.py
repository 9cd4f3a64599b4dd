"""One program on several devices: who has which worlds, and who fits what.

A mesh has one axis. Worlds are divided over it, and every device rolls out its own without a word to the others. What they saw is
gathered on all of them, and estimates are made by each for itself. Of the two fits

- each has a CPU device of its own, because there a gradient step is too short to be shared;
- accelerators share every minibatch, whose gradient XLA sums over them.

Several runs side by side are divided instead, if their number allows it: then nothing is exchanged at all.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

AXIS = "devices"

THREADS_PER_DEVICE = 2
"""Of JAX's pool on a CPU."""

_MESH: ContextVar[Mesh | None] = ContextVar("mesh", default=None)
"""Of the program that is being traced; None where a device is alone."""


def divide_cpu(count: int) -> None:
    """Let a CPU pose as so many devices; raises RuntimeError if JAX runs already.

    A device that waits for another blocks a thread of JAX's pool. With only as many threads as devices, what the other one needs a
    thread for might never begin, so there are more.
    """
    jax.config.update("jax_num_cpu_devices", count)
    if count > 1 or jax.distributed.is_initialized():
        os.environ["PJRT_NPROC"] = str(THREADS_PER_DEVICE * count)


def make_mesh(count: int) -> Mesh | None:
    """The first `count` devices; None for a single one."""
    return jax.make_mesh((count,), (AXIS,), (AxisType.Auto,), devices=jax.devices()[:count]) if count > 1 else None


@contextmanager
def shared_by(mesh: Mesh | None) -> Iterator[None]:
    """What is traced inside is shared by the devices of a mesh."""
    before = _MESH.set(mesh)
    try:
        yield
    finally:
        _MESH.reset(before)


def count() -> int:
    """Devices that share what is being traced."""
    mesh = _MESH.get()
    return 1 if mesh is None else mesh.size


def divided(f: Callable, take: tuple[int | None, ...], give: Any) -> Callable:
    """`f` on each device's share: argument i is divided along axis `take[i]`, or whole where that is None; results along `give`."""
    mesh = _MESH.get()
    if mesh is None:
        return f

    def alone(*args: Any) -> Any:
        with shared_by(None):
            return f(*args)

    return jax.shard_map(
        alone,
        mesh=mesh,
        in_specs=tuple(map(_spec, take)),
        out_specs=jax.tree.map(_spec, give, is_leaf=lambda x: x is None),
        check_vma=False,
    )


def divide(tree: Any, axis: int = 0) -> Any:
    """The tree with every array divided along an axis, where that comes out even."""
    mesh = _MESH.get()
    if mesh is None:
        return tree
    return jax.tree.map(lambda x: _put(x, mesh, None if x.shape[axis] % mesh.size else axis), tree)


def gather(tree: Any) -> Any:
    """The tree whole on every device."""
    mesh = _MESH.get()
    return tree if mesh is None else jax.tree.map(lambda x: _put(x, mesh, None), tree)


def side_by_side(*tasks: tuple[Callable, tuple]) -> tuple[Any, ...]:
    """The results of independent functions, each with its arguments: each on a CPU device of its own, or all on all accelerators."""
    mesh = _MESH.get()
    if mesh is None or not _apart(mesh):
        return tuple(f(*args) for f, args in tasks)
    functions, arguments = zip(*tasks, strict=True)
    shapes = [jax.eval_shape(f, *args) for f, args in tasks]

    def only(mine: int, arguments: tuple) -> tuple[Any, ...]:
        nothing = [jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape) for shape in shapes]
        return tuple(f(*args) if i == mine else nothing[i] for i, (f, args) in enumerate(zip(functions, arguments, strict=True)))

    def share(arguments: tuple) -> tuple[Any, ...]:
        branches = [partial(only, i) for i in range(len(functions) + 1)]  # the last has nothing to do
        return jax.lax.psum(jax.lax.switch(jnp.minimum(jax.lax.axis_index(AXIS), len(functions)), branches, arguments), AXIS)

    return divided(share, (None,), None)(arguments)


def _apart(mesh: Mesh) -> bool:
    return mesh.devices.flat[0].platform == "cpu"


def _spec(axis: int | None) -> PartitionSpec:
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, AXIS)


def _put(x: jax.Array, mesh: Mesh, axis: int | None) -> jax.Array:
    return jax.lax.with_sharding_constraint(x, NamedSharding(mesh, _spec(axis)))
