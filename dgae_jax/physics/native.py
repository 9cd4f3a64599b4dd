"""C MuJoCo inside a jitted program: `mujoco.batch` behind a pure callback, bit for bit what `mj_step` computes.

It compiles in seconds, runs on CPU threads, and is the referee for the other engines.
"""

import os
import threading

import jax
import mujoco
import numpy as np
from jaxtyping import Array
from mujoco.batch import Batch

from dgae_jax.physics import quiet
from dgae_jax.physics.engine import Physics, PhysicsState, Reads, body_ids, refuse_hidden_state

_FIELDS = ("qpos", "qvel", "qacc_warmstart")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Host:
    """Keeps one batch of simulations per batch size; the callback's only memory is these buffers."""

    def __init__(self, model: mujoco.MjModel, frame_skip: int, reads: Reads):
        self.model, self.frame_skip, self.reads, self.bodies = model, frame_skip, reads, body_ids(model, reads)
        self.threads = cores()
        self.batches: dict[int, Batch] = {}
        self.data = mujoco.MjData(model)
        self.lock = threading.Lock()  # a Batch serves one caller at a time

    def step(self, *arrays):
        lead, dtype = np.shape(arrays[0])[:-1], arrays[0].dtype
        count = int(np.prod(lead))
        with self.lock, quiet.silenced():
            batch = self._batch(count)
            for name, array in zip((*_FIELDS, "ctrl"), arrays, strict=True):
                batch.bind(name)[:] = np.asarray(array).reshape(count, -1)
            warned = _warnings(batch)
            batch.step(nstep=self.frame_skip)
            quiet.count(_warnings(batch) - warned)
            after = [batch.bind(name) for name in _FIELDS]
            after.append(batch.bind("xpos")[:, self.bodies])
            after.append(self._forces(batch) if self.reads.forces else np.empty((count, 0, 6)))
            return tuple(x.astype(dtype).reshape(*lead, *x.shape[1:]) for x in after)

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

    def step(state: PhysicsState, ctrl: Array) -> PhysicsState:
        like = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in state)
        return PhysicsState(*jax.pure_callback(host.step, like, *state[:3], ctrl, vmap_method="broadcast_all"))

    return Physics(model, step, "native", reads)
