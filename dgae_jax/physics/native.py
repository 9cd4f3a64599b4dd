"""C MuJoCo inside a jitted program: `mujoco.batch` behind a custom call, bit for bit what `mj_step` computes.

It compiles in seconds, runs on CPU threads, and is the referee for the other engines.
"""

import hashlib
import math
import os
import threading
from collections.abc import Sequence
from functools import partial

import jax
import mujoco
import numpy as np
from jaxtyping import Array
from mujoco.batch import Batch

from dgae_jax.physics import ffi, quiet
from dgae_jax.physics.engine import Physics, PhysicsState, Reads, body_ids, refuse_hidden_state

_FIELDS = ("qpos", "qvel", "qacc_warmstart")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Host:
    """Keeps one batch of simulations per batch size; the call's only memory is these buffers."""

    def __init__(self, model: mujoco.MjModel, frame_skip: int, reads: Reads):
        self.model, self.frame_skip, self.reads, self.bodies = model, frame_skip, reads, body_ids(model, reads)
        self.threads = cores()
        self.batches: dict[int, Batch] = {}
        self.data = mujoco.MjData(model)
        self.lock = threading.Lock()  # a Batch serves one caller at a time

    def step(self, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> None:
        """Fill the fields of a `PhysicsState` after a step, from those in `_FIELDS` and the control before it."""
        count = math.prod(before[0].shape[:-1])
        with self.lock, quiet.silenced():
            batch = self._batch(count)
            for name, array in zip((*_FIELDS, "ctrl"), before, strict=True):
                batch.bind(name)[:] = array.reshape(count, -1)
            warned = _warnings(batch)
            batch.step(nstep=self.frame_skip)
            quiet.count(_warnings(batch) - warned)
            forces = self._forces(batch) if self.reads.forces else np.empty((count, 0, 6))
            for array, value in zip(after, (*map(batch.bind, _FIELDS), batch.bind("xpos")[:, self.bodies], forces), strict=True):
                array[:] = value.reshape(array.shape)

    def returned(self, like: Sequence[jax.ShapeDtypeStruct], *before) -> tuple[np.ndarray, ...]:
        """The same for `jax.pure_callback`: `like` is the `PhysicsState` of one of the worlds."""
        lead = before[0].shape[: before[0].ndim - len(like[0].shape)]
        after = tuple(np.empty((*lead, *x.shape), x.dtype) for x in like)
        self.step([np.asarray(x) for x in before], after)
        return after

    def _batch(self, count: int) -> Batch:
        if count not in self.batches:
            # persistent simulations keep the contacts that the forces are computed from
            self.batches[count] = Batch(self.model, count, min(self.threads, count), persistent=self.reads.forces)
            self.batches[count].bind("xpos")  # outputs are copied from the next call on
        return self.batches[count]

    def _forces(self, batch: Batch) -> np.ndarray:
        """`mj_rnePostConstraint` after each step, as Gymnasium does."""
        forces = np.empty((batch.nsim, self.model.nbody, 6))
        for i in range(batch.nsim):
            batch.get_data(i, self.data)
            mujoco.mj_rnePostConstraint(self.model, self.data)
            forces[i] = self.data.cfrc_ext
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
            return jax.pure_callback(partial(host.returned, like), like, *before, vmap_method="broadcast_all")

        return PhysicsState(*jax.lax.platform_dependent(*state[:3], ctrl, cpu=on_cpu, default=elsewhere))

    return Physics(model, step, "native", reads)


def _digest(model: mujoco.MjModel, frame_skip: int, reads: Reads) -> str:
    """The same in every process: programs that are kept find their step by it."""
    binary = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, binary)
    return hashlib.sha256(binary.tobytes() + repr((frame_skip, reads)).encode()).hexdigest()[:32]
