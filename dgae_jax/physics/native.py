"""C MuJoCo inside a jitted program: `mujoco.batch` behind a pure callback, bit for bit what `mj_step` computes.

It compiles in a second, runs on CPU threads, and is the referee for the other engines.
"""

import os
import threading

import jax
import mujoco
import numpy as np
from mujoco.batch import Batch

from dgae_jax.physics.base import Physics, PhysicsState

_FIELDS = ("qpos", "qvel", "qacc_warmstart")


class _Host:
    """Keeps one batch of simulations per batch size; the callback's only memory is these buffers."""

    def __init__(self, model: mujoco.MjModel, frame_skip: int):
        self.model, self.frame_skip = model, frame_skip
        self.threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.batches: dict[int, Batch] = {}
        self.lock = threading.Lock()  # a Batch serves one caller at a time

    def step(self, *arrays):
        lead = np.shape(arrays[0])[:-1]
        count = int(np.prod(lead))
        with self.lock:
            if count not in self.batches:
                self.batches[count] = Batch(self.model, count, min(self.threads, count))
            batch = self.batches[count]
            for name, array in zip((*_FIELDS, "ctrl"), arrays, strict=True):
                batch.bind(name)[:] = np.asarray(array).reshape(count, -1)
            batch.step(nstep=self.frame_skip)
            return tuple(batch.bind(name).astype(a.dtype).reshape(*lead, -1) for name, a in zip(_FIELDS, arrays, strict=False))


def native(model: mujoco.MjModel, frame_skip: int) -> Physics:
    """C MuJoCo advancing every world of a batch on all cores of this process.

    A state that turns non-finite stays so and can be seen: C's own silent reset of such states is switched off.
    """
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    host = _Host(model, frame_skip)

    def step(state: PhysicsState, ctrl):
        like = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in state)
        return PhysicsState(*jax.pure_callback(host.step, like, *state, ctrl, vmap_method="broadcast_all"))

    return Physics(model, step, "native")
