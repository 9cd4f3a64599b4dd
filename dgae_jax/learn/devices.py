"""One program on several devices of a mesh with one axis.

Envs are divided over the devices, and each rolls out its own without communication. The data are
gathered on all of them, and each computes the estimates. On CPUs the policy's update runs on one
device and the critic's on another, because a gradient step is too short to be shared; accelerators
share every minibatch, and XLA sums its gradient over them.

Several seeds are divided instead, if their number allows it: then nothing is communicated at all.
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
"""Threads of JAX's CPU pool. A device that waits for another blocks a thread; with one thread per
device the work that it waits for might never begin."""

_MESH: ContextVar[Mesh | None] = ContextVar("mesh", default=None)
"""Mesh of the program that is being traced; None for a single device."""


def divide_cpu(count: int) -> None:
    """Split the CPU into JAX devices; raise RuntimeError if JAX has started already."""
    jax.config.update("jax_num_cpu_devices", count)
    if count > 1 or jax.distributed.is_initialized():
        os.environ["PJRT_NPROC"] = str(THREADS_PER_DEVICE * count)


def make_mesh(count: int) -> Mesh | None:
    """Return a mesh of the first `count` devices; None for a single one."""
    if count == 1:
        return None
    return jax.make_mesh((count,), (AXIS,), (AxisType.Auto,), devices=jax.devices()[:count])


@contextmanager
def shared_by(mesh: Mesh | None) -> Iterator[None]:
    """Share what is traced inside between the devices of a mesh."""
    before = _MESH.set(mesh)
    try:
        yield
    finally:
        _MESH.reset(before)


def count() -> int:
    """Return the number of devices that share what is being traced."""
    mesh = _MESH.get()
    return 1 if mesh is None else mesh.size


def divided(f: Callable, in_axes: tuple[int | None, ...], out_axes: Any) -> Callable:
    """Run `f` on each device's share of its arguments.

    Args:
        f: the function.
        in_axes: the axis along which each argument is divided; None for a whole argument.
        out_axes: the same for the results, a tree prefix.
    """
    mesh = _MESH.get()
    if mesh is None:
        return f

    def on_one_device(*args: Any) -> Any:
        with shared_by(None):
            return f(*args)

    return jax.shard_map(
        on_one_device,
        mesh=mesh,
        in_specs=tuple(map(_spec, in_axes)),
        out_specs=jax.tree.map(_spec, out_axes, is_leaf=lambda x: x is None),
        check_vma=False,
    )


def divide(tree: Any, axis: int | None = 0) -> Any:
    """Divide every array of a tree along an axis, where that comes out even; None to gather it."""
    mesh = _MESH.get()
    if mesh is None:
        return tree

    def put(x: jax.Array) -> jax.Array:
        even = axis is not None and x.shape[axis] % mesh.size == 0
        sharding = NamedSharding(mesh, _spec(axis if even else None))
        return jax.lax.with_sharding_constraint(x, sharding)

    return jax.tree.map(put, tree)


def concurrently(*tasks: tuple[Callable, tuple]) -> tuple[Any, ...]:
    """Call `(function, arguments)`: each on a CPU device of its own, or all on all accelerators."""
    mesh = _MESH.get()
    if mesh is None or mesh.devices.flat[0].platform != "cpu":
        return tuple(f(*args) for f, args in tasks)
    functions, arguments = zip(*tasks, strict=True)
    shapes = [jax.eval_shape(f, *args) for f, args in tasks]

    def only(mine: int, arguments: tuple) -> tuple[Any, ...]:
        zeros = [jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape) for shape in shapes]
        calls = enumerate(zip(functions, arguments, strict=True))
        return tuple(f(*args) if i == mine else zeros[i] for i, (f, args) in calls)

    def per_device(arguments: tuple) -> tuple[Any, ...]:
        branches = [partial(only, i) for i in range(len(functions) + 1)]  # the last one is idle
        branch = jnp.minimum(jax.lax.axis_index(AXIS), len(functions))
        return jax.lax.psum(jax.lax.switch(branch, branches, arguments), AXIS)

    return divided(per_device, (None,), None)(arguments)


def _spec(axis: int | None) -> PartitionSpec:
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, AXIS)
