"""Ant, Hopper, Swimmer and Walker2d, v4 and v5: constants and semantics are Gymnasium's own.

Gymnasium made v4 as Gym's v3 on the `mujoco` bindings. Hopper, Swimmer and Walker2d are the same in both; Ant's v3 also observes
84 contact forces and pays for them, which v4 does only with `use_contact_forces=True`.
"""

from math import inf

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dgae_jax.envs.task import HealthyTask, Task
from dgae_jax.physics.engine import Physics, PhysicsState, Reads

Range = tuple[float, float]


def _inside(x: Array, bounds: Range) -> Bool[Array, ""]:
    return ((bounds[0] < x) & (x < bounds[1])).all()


class Walker2d(HealthyTask):
    """Walk forward on two legs. Observation [17]: eight positions (m, rad), nine velocities clipped to ±10."""

    NAME, FILE = "Walker2d", {"v4": "walker2d.xml", "v5": "walker2d_v5.xml"}
    AXES, VELOCITY_LIMIT = 1, 10.0

    def __init__(
        self,
        physics: Physics,
        version: str,
        *,
        ctrl_cost_weight: float = 1e-3,
        healthy_z_range: Range = (0.8, 2.0),
        healthy_angle_range: Range = (-1.0, 1.0),
        reset_noise_scale: float = 5e-3,
        **parameters,
    ):
        super().__init__(
            physics,
            version,
            ctrl_cost_weight=ctrl_cost_weight,
            reset_noise_scale=reset_noise_scale,
            **parameters,
        )
        self._healthy_z_range = healthy_z_range
        self._healthy_angle_range = healthy_angle_range

    def _is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        return _inside(physics.qpos[1], self._healthy_z_range) & _inside(
            physics.qpos[2], self._healthy_angle_range
        )


class Hopper(Walker2d):
    """Hop forward on one leg. Observation [11]: five positions (m, rad), six velocities clipped to ±10."""

    NAME, FILE = "Hopper", {"v4": "hopper.xml", "v5": "hopper.xml"}

    def __init__(
        self,
        physics: Physics,
        version: str,
        *,
        healthy_state_range: Range = (-100.0, 100.0),
        healthy_z_range: Range = (0.7, inf),
        healthy_angle_range: Range = (-0.2, 0.2),
        **parameters,
    ):
        super().__init__(
            physics,
            version,
            healthy_z_range=healthy_z_range,
            healthy_angle_range=healthy_angle_range,
            **parameters,
        )
        self._healthy_state_range = healthy_state_range

    def _is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        rest = jnp.concatenate([physics.qpos, physics.qvel])[2:]
        return super()._is_healthy(physics) & _inside(rest, self._healthy_state_range)


class Swimmer(Task):
    """Swim forward in a plane. Observation [8]: three angles (rad), five velocities. It never terminates."""

    NAME, FILE = "Swimmer", {"v4": "swimmer.xml", "v5": "swimmer.xml"}
    AXES = 2
    TERMS = ("reward_forward", "reward_ctrl")

    def __init__(
        self,
        physics: Physics,
        version: str,
        *,
        ctrl_cost_weight: float = 1e-4,
        reset_noise_scale: float = 0.1,
        **parameters,
    ):
        super().__init__(
            physics,
            version,
            ctrl_cost_weight=ctrl_cost_weight,
            reset_noise_scale=reset_noise_scale,
            **parameters,
        )


class Ant(HealthyTask):
    """Walk forward on four legs. Observation [27]: 13 positions with a quaternion, 14 velocities; v5 adds contact forces [78].

    The reward's velocity is that of the torso as `mj_step` leaves it, one substep behind the position observed.
    """

    NAME, FILE, FRAME_SKIP = "Ant", dict.fromkeys(("v4", "v5"), "ant.xml"), 5
    AXES = 2
    TERMS = (*HealthyTask.TERMS, "reward_contact")

    def __init__(
        self,
        physics: Physics,
        version: str,
        *,
        ctrl_cost_weight: float = 0.5,
        contact_cost_weight: float = 5e-4,
        healthy_z_range: Range = (0.2, 1.0),
        contact_force_range: Range = (-1.0, 1.0),
        reset_noise_scale: float = 0.1,
        use_contact_forces: bool = False,
        include_cfrc_ext_in_observation: bool = True,
        **parameters,
    ):
        super().__init__(
            physics,
            version,
            ctrl_cost_weight=ctrl_cost_weight,
            reset_noise_scale=reset_noise_scale,
            **parameters,
        )
        self._contact_cost_weight = contact_cost_weight
        self._healthy_z_range = healthy_z_range
        self._contact_force_range = contact_force_range
        # v4 observes the forces on all bodies if asked to; v5 by default, and not the ones on the world
        observed = use_contact_forces if version == "v4" else include_cfrc_ext_in_observation
        self._observed_bodies = slice(0 if version == "v4" else 1, None if observed else 0)

    @staticmethod
    def reads(version: str, use_contact_forces: bool = False, **parameters) -> Reads:
        """The torso's position; contact forces always in v5, where asked for in v4."""
        return Reads(bodies=("torso",), forces=version == "v5" or use_contact_forces)

    def _position(self, physics: PhysicsState) -> Float[Array, "2"]:
        return physics.xpos[0, :2]

    def _is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        low, high = self._healthy_z_range
        state, height = jnp.concatenate([physics.qpos, physics.qvel]), physics.qpos[2]
        return jnp.isfinite(state).all() & (low <= height) & (height <= high)

    def _velocity_noise(self, key: Array) -> Float[Array, " V"]:
        return self._reset_noise_scale * jax.random.normal(key, (self._physics.model.nv,))

    def _forces(self, physics: PhysicsState) -> Float[Array, "E 6"]:
        return jnp.clip(physics.cfrc_ext, *self._contact_force_range)

    def _terms(self, before, after, action, velocity):
        cost = self._contact_cost_weight * jnp.square(self._forces(after)).sum()
        return {**super()._terms(before, after, action, velocity), "reward_contact": -cost}

    def _observation(self, physics: PhysicsState) -> Float[Array, " O"]:
        return jnp.concatenate(
            [super()._observation(physics), self._forces(physics)[self._observed_bodies].ravel()]
        )
