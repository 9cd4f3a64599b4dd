"""The contract of a physics engine: advance a small state by one control interval.

A task declares what it reads (`Reads`), and an engine returns it in a `PhysicsState`. An engine is
a function of a model (`MjSpec`), the number of substeps and `Reads` that returns a `Physics`, or
raises ValueError for a model that it does not cover; `registry` names them.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float


class Reads(NamedTuple):
    """The quantities that a task reads besides positions and velocities."""

    bodies: tuple[str, ...] = ()
    """Names of bodies for `xpos`; each must have a free joint (`body_ids`)."""
    forces: bool = False
    """True if the task reads `cfrc_ext`."""


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
    """Positions of the bodies in `Reads.bodies` [m]."""
    cfrc_ext: Float[Array, "*batch E 6"]
    """External torque and force on each body [Nm, N]; E = 0 unless `Reads.forces`."""


@runtime_checkable
class StepFn(Protocol):
    """Advance by `frame_skip` substeps under the control `ctrl` [U]; may be jitted and vmapped."""

    def __call__(self, state: PhysicsState, ctrl: Array, /) -> PhysicsState: ...


class Physics(NamedTuple):
    """A model and the function that advances it."""

    model: mujoco.MjModel
    step: StepFn
    name: str
    """Key of `registry.ENGINES`."""
    reads: Reads

    def init(self, qpos: Float[Array, "*batch Q"], qvel: Float[Array, "*batch V"]) -> PhysicsState:
        """Return the state at a pose, with the cold warm start of a fresh `mjData`.

        No forward pass: bodies that a task reads float freely, so `xpos` is a part of `qpos`.
        """
        model, batch = self.model, qpos.shape[:-1]
        addresses = model.jnt_qposadr[model.body_jntadr[body_ids(model, self.reads)]]
        xpos = qpos[..., addresses[:, None] + np.arange(3)]
        forces = jnp.zeros((*batch, model.nbody if self.reads.forces else 0, 6), qpos.dtype)
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel), xpos, forces)


def body_ids(model: mujoco.MjModel, reads: Reads) -> np.ndarray:
    """Return the ids of the bodies that a task reads.

    Raises:
        ValueError: if a body is not in the model or has no free joint.
    """
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in reads.bodies]
    for body, name in zip(ids, reads.bodies, strict=True):
        if body < 0:
            raise ValueError(f"the model has no body {name!r}")
        joint = model.body_jntadr[body]
        if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"the position of body {name!r} cannot be read: it has no free joint")
    return np.array(ids, int)


def refuse_hidden_state(model: mujoco.MjModel, name: str) -> None:
    """Raise ValueError for a model with a state that `PhysicsState` does not carry."""
    states = {"activations": "na", "histories": "nhistory", "user data": "nuserdata"}
    states["plugin states"] = "npluginstate"
    found = [state for state, size in states.items() if getattr(model, size, 0)]
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
