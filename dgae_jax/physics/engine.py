"""What a task asks of a physics engine: advance a small state by one control interval.

A task says what it looks at (`Reads`) and an engine returns it in a `PhysicsState`. Engines are functions
`(spec, frame_skip, reads) -> Physics`; `registry` names them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float


class Reads(NamedTuple):
    """What a task looks at besides positions and velocities."""

    bodies: tuple[str, ...] = ()
    """Names of bodies whose position it reads; each must float freely (`body_ids`)."""
    forces: bool = False
    """Whether it reads the external forces on the bodies."""


class PhysicsState(NamedTuple):
    """All that MuJoCo needs to continue exactly: a few hundred bytes per world instead of a whole `mjData`.

    The fields are those of `mjData`, by its names. `xpos` and `cfrc_ext` are what Gymnasium reads after `mj_step`, which leaves
    them one substep behind: MuJoCo last computed them in the fourth stage of its last RK4 step.
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
    """External torque and force on each body of the model [Nm, N]; E = 0 unless `Reads.forces`."""


class Physics(NamedTuple):
    """A model and how to advance it; `step` is pure and may be jitted and vmapped."""

    model: mujoco.MjModel
    step: Callable[[PhysicsState, Array], PhysicsState]
    """`step(state, ctrl [U]) -> state` after `frame_skip` substeps under a constant control."""
    name: str
    """The engine's, as in `registry.ENGINES`."""
    reads: Reads

    def at_pose(
        self, qpos: Float[Array, "*batch Q"], qvel: Float[Array, "*batch V"]
    ) -> PhysicsState:
        """The state at a pose, with the cold warm start of a fresh `mjData`: a reset costs no forward pass."""
        model, lead = self.model, qpos.shape[:-1]
        addresses = model.jnt_qposadr[model.body_jntadr[body_ids(model, self.reads)]]
        xpos = qpos[..., addresses[:, None] + np.arange(3)]
        forces = jnp.zeros((*lead, model.nbody if self.reads.forces else 0, 6), qpos.dtype)
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel), xpos, forces)


def body_ids(model: mujoco.MjModel, reads: Reads) -> np.ndarray:
    """Numbers of the bodies that a task reads.

    Raises ValueError for a body that is not in the model, or does not float freely: its position would not be a part of
    `qpos`, and a reset computes no kinematics.
    """
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in reads.bodies]
    for number, name in zip(ids, reads.bodies, strict=True):
        if number < 0:
            raise ValueError(f"the model has no body {name!r}")
        joint = model.body_jntadr[number]
        if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"the position of body {name!r} cannot be read: it has no free joint")
    return np.array(ids, int)


def refuse_hidden_state(model: mujoco.MjModel, name: str) -> None:
    """Raise ValueError, naming it, for a model with a state that `PhysicsState` does not carry from step to step."""
    sizes = {
        "activations": "na",
        "histories": "nhistory",
        "plugin states": "npluginstate",
        "user data": "nuserdata",
    }
    found = [what for what, size in sizes.items() if getattr(model, size, 0)]
    if found:
        raise ValueError(f"physics {name} does not cover {', '.join(found)}, which the model has")
