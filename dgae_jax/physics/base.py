"""What a task asks of a physics engine: advance a small state by one control interval."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float


class PhysicsState(NamedTuple):
    """All that MuJoCo needs to continue exactly: a few hundred bytes per world instead of a whole `mjData`."""

    qpos: Float[Array, "*batch Q"]
    qvel: Float[Array, "*batch V"]
    warmstart: Float[Array, "*batch V"]
    """The last acceleration, where the constraint solver starts."""


class Physics(NamedTuple):
    """A model and how to advance it; `step` is pure and may be jitted and vmapped."""

    model: mujoco.MjModel
    step: Callable[[PhysicsState, Array], PhysicsState]
    """`step(state, ctrl [U]) -> state` after `frame_skip` substeps under a constant control."""
    name: str


def at_pose(qpos: Float[Array, "*batch Q"], qvel: Float[Array, "*batch V"]) -> PhysicsState:
    """The state at a pose, with the cold warm start of a fresh `mjData`: a reset costs no forward pass."""
    return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))
