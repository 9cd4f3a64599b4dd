"""C MuJoCo inside a jitted program: `mujoco.batch` behind a pure callback, bit for bit what `mj_step` computes.

It compiles in seconds, runs on CPU threads, and is the referee for the other engines.
"""

import os
import threading

import jax
import mujoco
import numpy as np
from mujoco.batch import Batch

from dgae_jax.physics.engine import Physics, PhysicsState, has_free_root

_FIELDS = ("qpos", "qvel", "qacc_warmstart")


class _Host:
    """Keeps one batch of simulations per batch size; the callback's only memory is these buffers."""

    def __init__(self, model: mujoco.MjModel, frame_skip: int, contact_forces: bool):
        self.model, self.frame_skip, self.contact_forces = model, frame_skip, contact_forces
        self.threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.batches: dict[int, Batch] = {}
        self.data = mujoco.MjData(model)
        self.lock = threading.Lock()  # a Batch serves one caller at a time

    def step(self, *arrays):
        lead, dtype = np.shape(arrays[0])[:-1], arrays[0].dtype
        count = int(np.prod(lead))
        with self.lock:
            batch = self._batch(count)
            for name, array in zip((*_FIELDS, "ctrl"), arrays, strict=True):
                batch.bind(name)[:] = np.asarray(array).reshape(count, -1)
            batch.step(nstep=self.frame_skip)
            after = [batch.bind(name) for name in _FIELDS]
            after.append(batch.bind("xpos")[:, 1, :] if has_free_root(self.model) else np.empty((count, 0)))
            after.append(self._contact(batch) if self.contact_forces else np.empty((count, 0, 6)))
            return tuple(x.astype(dtype).reshape(*lead, *x.shape[1:]) for x in after)

    def _batch(self, count: int) -> Batch:
        if count not in self.batches:
            # persistent simulations keep the contacts that the forces are computed from
            self.batches[count] = Batch(self.model, count, min(self.threads, count), persistent=self.contact_forces)
            self.batches[count].bind("xpos")  # outputs are copied from the next call on
        return self.batches[count]

    def _contact(self, batch: Batch) -> np.ndarray:
        """`mj_rnePostConstraint` after each step, as Gymnasium does."""
        forces = np.empty((batch.nsim, self.model.nbody, 6))
        for i in range(batch.nsim):
            batch.get_data(i, self.data)
            mujoco.mj_rnePostConstraint(self.model, self.data)
            forces[i] = self.data.cfrc_ext
        return forces


def native(spec: mujoco.MjSpec, frame_skip: int, *, contact_forces: bool = False, max_contacts: int | None = None) -> Physics:
    """C MuJoCo advancing every world of a batch on all cores of this process; `max_contacts` is no matter to it.

    A state that turns non-finite stays so and can be seen: C's own silent reset of such states is switched off.
    """
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    host = _Host(model, frame_skip, contact_forces)

    def step(state: PhysicsState, ctrl):
        like = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in state)
        return PhysicsState(*jax.pure_callback(host.step, like, *state[:3], ctrl, vmap_method="broadcast_all"))

    return Physics(model, step, "native", contact_forces)
