"""What a task asks of a physics engine: advance a small state by one control interval."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float


class PhysicsState(NamedTuple):
    """All that MuJoCo needs to continue exactly: a few hundred bytes per world instead of a whole `mjData`.

    `torso` and `contact` are what Gymnasium reads after `mj_step`, which leaves them one substep behind: MuJoCo last
    computed them in the fourth stage of its last RK4 step.
    """

    qpos: Float[Array, "*batch Q"]
    qvel: Float[Array, "*batch V"]
    warmstart: Float[Array, "*batch V"]
    """The last acceleration, where the constraint solver starts."""
    torso: Float[Array, "*batch D"]
    """Position of a floating torso [m], D = 3; empty for a model whose root is not a free joint."""
    contact: Float[Array, "*batch E 6"]
    """External torque and force on each body, `cfrc_ext` [Nm, N]; empty unless the physics was asked for it."""


class Physics(NamedTuple):
    """A model and how to advance it; `step` is pure and may be jitted and vmapped."""

    model: mujoco.MjModel
    step: Callable[[PhysicsState, Array], PhysicsState]
    """`step(state, ctrl [U]) -> state` after `frame_skip` substeps under a constant control."""
    name: str
    contact_forces: bool

    def at_pose(self, qpos: Float[Array, "*batch Q"], qvel: Float[Array, "*batch V"]) -> PhysicsState:
        """The state at a pose, with the cold warm start of a fresh `mjData`: a reset costs no forward pass."""
        lead, bodies = qpos.shape[:-1], self.model.nbody if self.contact_forces else 0
        torso = qpos[..., : 3 if has_free_root(self.model) else 0]
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel), torso, jnp.zeros((*lead, bodies, 6), qpos.dtype))


def has_free_root(model: mujoco.MjModel) -> bool:
    """Whether the first joint floats freely."""
    return model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
