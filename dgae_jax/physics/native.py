"""C MuJoCo inside a jitted program: `mujoco.batch` in a custom call, bit for bit `mj_step`.

It compiles in seconds, runs on CPU threads, and is the reference for the other engines.
"""

import contextlib
import hashlib
import logging
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial

import jax
import mujoco
import numpy as np
from jaxtyping import Array
from mujoco.batch import Batch

from dgae_jax.physics import cores, ffi
from dgae_jax.physics.engine import Physics, PhysicsState, Reads, refuse_hidden_state

_LOG = logging.getLogger(__name__)
_INPUTS = ("qpos", "qvel", "qacc_warmstart")

WARNING_COUNTS: Counter[str] = Counter()
"""Warnings of C MuJoCo in this process while `native` stepped, by MuJoCo's name."""


def _count_warnings(new: np.ndarray) -> None:
    """Add new warnings, one number per kind; only the first of each kind is logged."""
    for i in np.flatnonzero(new).tolist():
        kind = mujoco.mjtWarning(i).name.removeprefix("mjWARN_")
        if kind not in WARNING_COUNTS:
            _LOG.warning("MuJoCo warns of %s in physics native; more are only counted", kind)
        WARNING_COUNTS[kind] += int(new[i])


class _Simulations:
    """Batches of simulations by their size; JAX's CPU devices call concurrently."""

    def __init__(self, model: mujoco.MjModel, frame_skip: int, reads: Reads):
        self.model, self.frame_skip, self.reads = model, frame_skip, reads
        self.free: dict[int, list[Batch]] = {}

    def step(self, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> None:
        """Fill the fields of a `PhysicsState` from `_INPUTS` and the control before the step."""
        count = math.prod(before[0].shape[:-1])
        with self._batch(count) as batch:
            for name, array in zip((*_INPUTS, "ctrl"), before, strict=True):
                batch.bind(name)[:] = array.reshape(count, -1)
            warnings = batch.warning[..., 1].sum(0)
            batch.step(nstep=self.frame_skip)
            _count_warnings(batch.warning[..., 1].sum(0) - warnings)
            forces = self._forces(batch) if self.reads.cfrc_ext else np.empty((count, 0, 6))
            xpos = batch.bind("xpos")[:, 1 : 1 + self.reads.xpos]
            values = (*map(batch.bind, _INPUTS), xpos, forces)
            for array, value in zip(after, values, strict=True):
                array[:] = value.reshape(array.shape)

    def callback(self, like: Sequence[jax.ShapeDtypeStruct], *before) -> tuple[np.ndarray, ...]:
        """Step under `jax.pure_callback`; `like` is the `PhysicsState` of one env."""
        batch = before[0].shape[: before[0].ndim - len(like[0].shape)]
        after = tuple(np.empty((*batch, *x.shape), x.dtype) for x in like)
        self.step([np.asarray(x) for x in before], after)
        return after

    @contextlib.contextmanager
    def _batch(self, count: int) -> Iterator[Batch]:
        """Lend simulations that no other thread uses; their previous state does not matter."""
        free = self.free.setdefault(count, [])
        try:
            batch = free.pop()
        except IndexError:
            threads = max(1, cores() // jax.local_device_count("cpu"))
            # persistent simulations keep the contacts that the forces are computed from
            batch = Batch(self.model, count, min(threads, count), persistent=self.reads.cfrc_ext)
            batch.bind("xpos")  # outputs are copied from the next call on
        yield batch
        free.append(batch)

    def _forces(self, batch: Batch) -> np.ndarray:
        """Call `mj_rnePostConstraint` after each step, as Gymnasium does."""
        forces, data = np.empty((batch.nsim, self.model.nbody, 6)), mujoco.MjData(self.model)
        for i in range(batch.nsim):
            batch.get_data(i, data)
            mujoco.mj_rnePostConstraint(self.model, data)
            forces[i] = data.cfrc_ext
        return forces


def native(spec: mujoco.MjSpec, frame_skip: int, reads: Reads) -> Physics:
    """Build C MuJoCo, advancing all envs of a batch on all cores of this process.

    A non-finite state stays visible: C's own silent reset of such states is switched off.
    """
    model = spec.compile()
    refuse_hidden_state(model, "native")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    simulations = _Simulations(model, frame_skip, reads)
    target = f"dgae_jax_native_{_digest(model, frame_skip, reads)}"
    ffi.register(target, simulations.step)

    def step(state: PhysicsState, ctrl: Array) -> PhysicsState:
        like = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in state)
        on_cpu = jax.ffi.ffi_call(target, like, vmap_method="broadcast_all")

        def elsewhere(*before):
            function = partial(simulations.callback, like)
            return jax.pure_callback(function, like, *before, vmap_method="broadcast_all")

        after = jax.lax.platform_dependent(*state[:3], ctrl, cpu=on_cpu, default=elsewhere)
        return PhysicsState(*after)

    return Physics(model, step, "native", reads)


def _digest(model: mujoco.MjModel, frame_skip: int, reads: Reads) -> str:
    """Return the same name in every process: cached programs find their step by it."""
    binary = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, binary)
    return hashlib.sha256(binary.tobytes() + repr((frame_skip, reads)).encode()).hexdigest()[:32]
