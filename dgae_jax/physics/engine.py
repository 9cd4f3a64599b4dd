"""The contract of a physics engine: advance a small state by one control interval.

A task declares what it reads (`Reads`), and an engine returns it in a `PhysicsState`. An engine is
a function of a model (`MjSpec`), the number of substeps and `Reads` that returns a `Physics`, or
raises ValueError for a model that it does not cover; `registry` names them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float


class Reads(NamedTuple):
    """The quantities that a task reads besides positions and velocities."""

    xpos: bool = False
    """True if the task reads the position of the root, which must have a free joint."""
    cfrc_ext: bool = False
    """True if the task reads the external forces."""


class PhysicsState(NamedTuple):
    """All that MuJoCo needs to continue exactly: a few hundred bytes per env, not a whole `mjData`.

    The fields are those of `mjData`. `xpos` and `cfrc_ext` are what Gymnasium reads after
    `mj_step`, one substep behind: MuJoCo computes them last in the fourth stage of RK4.
    """

    qpos: Float[Array, "*batch Q"]
    """Joint positions [m, rad, quaternions]."""
    qvel: Float[Array, "*batch V"]
    """Joint velocities [m/s, rad/s]."""
    qacc_warmstart: Float[Array, "*batch V"]
    """The last acceleration [m/s², rad/s²], where the constraint solver starts."""
    xpos: Float[Array, "*batch B 3"]
    """Position of the root [m]; B = 0 unless `Reads.xpos`."""
    cfrc_ext: Float[Array, "*batch E 6"]
    """External torque and force on each body [Nm, N]; E = 0 unless `Reads.cfrc_ext`."""


StepFn = Callable[[PhysicsState, Array], PhysicsState]
"""Advances by `frame_skip` substeps under the control `ctrl` [U]; may be jitted and vmapped."""


class Physics(NamedTuple):
    """A model and the function that advances it."""

    model: mujoco.MjModel
    step: StepFn
    name: str
    """Key of `registry.ENGINES`."""
    reads: Reads

    def init(self, qpos: Float[Array, "*batch Q"], qvel: Float[Array, "*batch V"]) -> PhysicsState:
        """Return the state at a pose, with the cold warm start of a fresh `mjData`.

        No forward pass: a root that a task reads floats freely, so `xpos` is a part of `qpos`.
        """
        batch, bodies = qpos.shape[:-1], self.model.nbody if self.reads.cfrc_ext else 0
        xpos = qpos[..., None, :3] if self.reads.xpos else jnp.zeros((*batch, 0, 3), qpos.dtype)
        forces = jnp.zeros((*batch, bodies, 6), qpos.dtype)
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel), xpos, forces)


def silence_warnings() -> None:
    """Keep MuJoCo from printing warnings and writing MUJOCO_LOG.TXT, unless the user has a way."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(lambda message: None)


def refuse_hidden_state(model: mujoco.MjModel, name: str) -> None:
    """Raise ValueError for a model with a state that `PhysicsState` does not carry."""
    found = [n for n in ("na", "nhistory", "nuserdata", "npluginstate") if getattr(model, n)]
    if found:
        raise ValueError(f"physics {name} does not cover {', '.join(found)}, which the model has")


def single_env(batched_step: StepFn) -> StepFn:
    """Return the step of one env, given a step of a batch with the env axis last.

    However the result is vmapped, nested too, all envs arrive in one call of `batched_step`.
    """

    @jax.custom_batching.custom_vmap
    def many(state, ctrl):
        return batched_step(state, ctrl)

    @many.def_vmap
    def _(size, batched, *args):
        envs = args[1].shape[-1]

        def merge(x, is_batched):
            x = jnp.moveaxis(x, 0, -2) if is_batched else jnp.repeat(x[..., None, :], size, -2)
            return x.reshape(*x.shape[:-2], size * envs)

        def split(x):
            return jnp.moveaxis(x.reshape(*x.shape[:-1], size, envs), -2, 0)

        out = many(*jax.tree.map(merge, args, tuple(batched)))
        return jax.tree.map(split, out), jax.tree.map(lambda _: True, out)

    def step(state: PhysicsState, ctrl: Array) -> PhysicsState:
        batch = jax.tree.map(lambda x: x[..., None], (state, ctrl))
        return jax.tree.map(lambda x: x[..., 0], many(*batch))

    return step
