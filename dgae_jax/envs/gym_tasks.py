"""Ant, Hopper, Swimmer and Walker2d, v4 and v5, with Gymnasium's constants and semantics.

Gymnasium's v4 is Gym's v3 on the `mujoco` bindings. Hopper, Swimmer and Walker2d are the same in
both; Ant's v3 also observes 84 contact forces and pays for them, which v4 does only with
`use_contact_forces=True`.
"""

from dataclasses import dataclass
from math import inf

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dgae_jax.envs.task import HealthyTask, Task, load_spec
from dgae_jax.physics.engine import PhysicsState, Reads
from dgae_jax.physics.registry import make_physics

Range = tuple[float, float]


def _inside(x: Array, bounds: Range) -> Bool[Array, ""]:
    return ((bounds[0] < x) & (x < bounds[1])).all()


@dataclass(eq=False)
class Walker2d(HealthyTask):
    """Walk on two legs. Observation [17]: 8 positions (m, rad), 9 velocities clipped to ±10."""

    ctrl_cost_weight: float = 1e-3
    healthy_z_range: Range = (0.8, 2.0)
    healthy_angle_range: Range = (-1.0, 1.0)
    reset_noise_scale: float = 5e-3

    NAME, FILE = "Walker2d", {"v4": "walker2d.xml", "v5": "walker2d_v5.xml"}
    AXES, VELOCITY_LIMIT = 1, 10.0

    def _is_healthy(self, state: PhysicsState) -> Bool[Array, ""]:
        height, angle = state.qpos[1], state.qpos[2]
        return _inside(height, self.healthy_z_range) & _inside(angle, self.healthy_angle_range)


@dataclass(eq=False)
class Hopper(Walker2d):
    """Hop on one leg. Observation [11]: 5 positions (m, rad), 6 velocities clipped to ±10."""

    healthy_state_range: Range = (-100.0, 100.0)
    healthy_z_range: Range = (0.7, inf)
    healthy_angle_range: Range = (-0.2, 0.2)

    NAME, FILE = "Hopper", {"v4": "hopper.xml", "v5": "hopper.xml"}

    def _is_healthy(self, state: PhysicsState) -> Bool[Array, ""]:
        rest = jnp.concatenate([state.qpos, state.qvel])[2:]
        return super()._is_healthy(state) & _inside(rest, self.healthy_state_range)


@dataclass(eq=False)
class Swimmer(Task):
    """Swim in a plane. Observation [8]: 3 angles (rad), 5 velocities. It never terminates."""

    ctrl_cost_weight: float = 1e-4
    reset_noise_scale: float = 0.1

    NAME, FILE, AXES = "Swimmer", {"v4": "swimmer.xml", "v5": "swimmer.xml"}, 2


@dataclass(eq=False)
class Ant(HealthyTask):
    """Walk on four legs. Observation [27]: 13 positions, 14 velocities; v5 adds 78 contact forces.

    The rewarded velocity is that of the torso as `mj_step` leaves it, one substep behind the
    observed position.
    """

    ctrl_cost_weight: float = 0.5
    contact_cost_weight: float = 5e-4
    healthy_z_range: Range = (0.2, 1.0)
    contact_force_range: Range = (-1.0, 1.0)
    reset_noise_scale: float = 0.1
    use_contact_forces: bool = False
    """Observe contact forces in v4."""
    include_cfrc_ext_in_observation: bool = True
    """Observe contact forces in v5."""

    NAME, FILE, FRAME_SKIP, AXES = "Ant", {"v4": "ant.xml", "v5": "ant.xml"}, 5, 2

    @staticmethod
    def reads(version: str, use_contact_forces: bool = False, **parameters) -> Reads:
        """Read the torso's position; contact forces always in v5, if asked for in v4."""
        return Reads(xpos=True, cfrc_ext=version == "v5" or use_contact_forces)

    def _position(self, state: PhysicsState) -> Float[Array, "2"]:
        return state.xpos[0, :2]

    def _is_healthy(self, state: PhysicsState) -> Bool[Array, ""]:
        low, high = self.healthy_z_range
        everything, height = jnp.concatenate([state.qpos, state.qvel]), state.qpos[2]
        return jnp.isfinite(everything).all() & (low <= height) & (height <= high)

    def _velocity_noise(self, key: Array) -> Float[Array, " V"]:
        return self.reset_noise_scale * jax.random.normal(key, (self.physics.model.nv,))

    def _forces(self, state: PhysicsState) -> Float[Array, "E 6"]:
        return jnp.clip(state.cfrc_ext, *self.contact_force_range)

    def _terms(self, before, after, action, velocity):
        cost = self.contact_cost_weight * jnp.square(self._forces(after)).sum()
        return {**super()._terms(before, after, action, velocity), "reward_contact": -cost}

    def _observation(self, state: PhysicsState) -> Float[Array, " O"]:
        observation = super()._observation(state)
        if self.version == "v4":
            observed = slice(None if self.use_contact_forces else 0)
        else:  # without the world body
            observed = slice(1, None if self.include_cfrc_ext_in_observation else 0)
        return jnp.concatenate([observation, self._forces(state)[observed].ravel()])


GYM_TASKS: dict[str, type[Task]] = {
    task.NAME.lower(): task for task in (Ant, Hopper, Swimmer, Walker2d)
}


def make_gym_task(name: str, physics: str, version: str, **parameters) -> Task:
    """Build a task over the engine named `physics`."""
    task = GYM_TASKS[name]
    spec, reads = load_spec(task.FILE[version]), task.reads(version, **parameters)
    return task(make_physics(physics, spec, task.FRAME_SKIP, reads), version, **parameters)
