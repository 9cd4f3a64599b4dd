"""C MuJoCo inside a jitted program: `mujoco.batch` behind a custom call, bit for bit what `mj_step` computes.

It compiles in seconds, runs on CPU threads, and is the referee for the other engines.
"""

import contextlib
import hashlib
import math
from collections.abc import Iterator, Sequence
from functools import partial

import jax
import mujoco
import numpy as np
from jaxtyping import Array
from mujoco.batch import Batch

from dgae_jax.physics import ffi, quiet
from dgae_jax.physics.cores import cores
from dgae_jax.physics.engine import Physics, PhysicsState, Reads, body_ids, refuse_hidden_state

_FIELDS = ("qpos", "qvel", "qacc_warmstart")


class _Host:
    """Keeps simulations per batch size, and takes others where those are in use: CPU devices of JAX call side by side."""

    def __init__(self, model: mujoco.MjModel, frame_skip: int, reads: Reads):
        self.model, self.frame_skip, self.reads, self.bodies = (
            model,
            frame_skip,
            reads,
            body_ids(model, reads),
        )
        self.free: dict[int, list[Batch]] = {}

    def step(self, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> None:
        """Fill the fields of a `PhysicsState` after a step, from those in `_FIELDS` and the control before it."""
        count = math.prod(before[0].shape[:-1])
        with self._batch(count) as batch, quiet.silenced():
            for name, array in zip((*_FIELDS, "ctrl"), before, strict=True):
                batch.bind(name)[:] = array.reshape(count, -1)
            warned = _warnings(batch)
            batch.step(nstep=self.frame_skip)
            quiet.count(_warnings(batch) - warned)
            forces = self._forces(batch) if self.reads.forces else np.empty((count, 0, 6))
            for array, value in zip(
                after,
                (*map(batch.bind, _FIELDS), batch.bind("xpos")[:, self.bodies], forces),
                strict=True,
            ):
                array[:] = value.reshape(array.shape)

    def returned(self, like: Sequence[jax.ShapeDtypeStruct], *before) -> tuple[np.ndarray, ...]:
        """The same for `jax.pure_callback`: `like` is the `PhysicsState` of one of the worlds."""
        lead = before[0].shape[: before[0].ndim - len(like[0].shape)]
        after = tuple(np.empty((*lead, *x.shape), x.dtype) for x in like)
        self.step([np.asarray(x) for x in before], after)
        return after

    @contextlib.contextmanager
    def _batch(self, count: int) -> Iterator[Batch]:
        """Simulations that nobody else uses meanwhile; what was written to them before does not count."""
        free = self.free.setdefault(count, [])
        try:
            batch = free.pop()
        except IndexError:
            threads = max(1, cores() // jax.local_device_count("cpu"))
            # persistent simulations keep the contacts that the forces are computed from
            batch = Batch(self.model, count, min(threads, count), persistent=self.reads.forces)
            batch.bind("xpos")  # outputs are copied from the next call on
        yield batch
        free.append(batch)

    def _forces(self, batch: Batch) -> np.ndarray:
        """`mj_rnePostConstraint` after each step, as Gymnasium does."""
        forces, data = np.empty((batch.nsim, self.model.nbody, 6)), mujoco.MjData(self.model)
        for i in range(batch.nsim):
            batch.get_data(i, data)
            mujoco.mj_rnePostConstraint(self.model, data)
            forces[i] = data.cfrc_ext
        return forces


def _warnings(batch: Batch) -> np.ndarray:
    """How often each kind of warning was raised so far, over all simulations."""
    return batch.warning[..., 1].sum(0)


def native(spec: mujoco.MjSpec, frame_skip: int, reads: Reads) -> Physics:
    """C MuJoCo advancing every world of a batch on all cores of this process.

    A state that turns non-finite stays so and can be seen: C's own silent reset of such states is switched off. Raises
    ValueError for a model with a state beyond positions and velocities.
    """
    model = spec.compile()
    refuse_hidden_state(model, "native")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    host = _Host(model, frame_skip, reads)
    name = f"dgae_jax_native_{_digest(model, frame_skip, reads)}"
    ffi.register(name, host.step)

    def step(state: PhysicsState, ctrl: Array) -> PhysicsState:
        like = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in state)
        on_cpu = jax.ffi.ffi_call(name, like, vmap_method="broadcast_all")

        def elsewhere(*before):  # JAX's device is not the CPU
            return jax.pure_callback(
                partial(host.returned, like), like, *before, vmap_method="broadcast_all"
            )

        return PhysicsState(
            *jax.lax.platform_dependent(*state[:3], ctrl, cpu=on_cpu, default=elsewhere)
        )

    return Physics(model, step, "native", reads)


def _digest(model: mujoco.MjModel, frame_skip: int, reads: Reads) -> str:
    """The same in every process: programs that are kept find their step by it."""
    binary = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, binary)
    return hashlib.sha256(binary.tobytes() + repr((frame_skip, reads)).encode()).hexdigest()[:32]
