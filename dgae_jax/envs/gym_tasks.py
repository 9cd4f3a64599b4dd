"""Gymnasium's MuJoCo tasks as `brax.envs.base.Env`, over any physics.

Model files and semantics are Gymnasium's own; the time limit belongs to the rollout, not to the task.
"""

from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
from brax.envs.base import Env, State
from jaxtyping import Array, Float

from dgae_jax.physics.base import Physics, PhysicsState, at_pose


def load_model(filename: str) -> mujoco.MjModel:
    """A model file of the installed gymnasium package, read without importing gymnasium."""
    spec = find_spec("gymnasium")
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError("the model files come from the package gymnasium, which is not installed")
    path = Path(spec.submodule_search_locations[0]) / "envs" / "mujoco" / "assets" / filename
    return mujoco.MjModel.from_xml_path(str(path))


class Hopper(Env):
    """Hop forward without falling: Gymnasium's Hopper-v4, the same task as Gym's v3.

    Observation [11]: height, torso angle, three joint angles (m, rad), then six velocities clipped to ±10 (m/s, rad/s).
    Action [3]: joint torques as a share of the gear, in [−1, 1]. Reward: forward velocity + healthy − control cost.
    """

    FILE: ClassVar = "hopper.xml"
    FRAME_SKIP: ClassVar = 4
    REFEREE: ClassVar = "Hopper-v4"
    EPISODE_LENGTH: ClassVar = 1000

    def __init__(
        self,
        physics: Physics,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 1e-3,
        healthy_reward: float = 1.0,
        terminate_when_unhealthy: bool = True,
        healthy_state_range: tuple[float, float] = (-100.0, 100.0),
        healthy_z_range: tuple[float, float] = (0.7, inf),
        healthy_angle_range: tuple[float, float] = (-0.2, 0.2),
        reset_noise_scale: float = 5e-3,
        exclude_current_positions_from_observation: bool = True,
    ):
        self._physics = physics
        self._forward_reward_weight = forward_reward_weight
        self._ctrl_cost_weight = ctrl_cost_weight
        self._healthy_reward = healthy_reward
        self._terminate_when_unhealthy = terminate_when_unhealthy
        self._healthy_state_range = healthy_state_range
        self._healthy_z_range = healthy_z_range
        self._healthy_angle_range = healthy_angle_range
        self._reset_noise_scale = reset_noise_scale
        self._first_position = int(exclude_current_positions_from_observation)
        self._init_qpos = jnp.asarray(physics.model.qpos0)

    @property
    def dt(self) -> float:
        """Seconds of simulated time per environment step."""
        return self._physics.model.opt.timestep * self.FRAME_SKIP

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return self._physics.model.nq + self._physics.model.nv - self._first_position

    @property
    def action_size(self) -> int:
        """Number of actuators."""
        return self._physics.model.nu

    @property
    def action_range(self) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
        """The actuators' lowest and highest control."""
        low, high = self._physics.model.actuator_ctrlrange.T
        return jnp.asarray(low), jnp.asarray(high)

    @property
    def backend(self) -> str:
        """Name of the physics."""
        return self._physics.name

    def reset(self, rng: Array) -> State:
        """A fresh random pose: uniform noise of ±reset_noise_scale on positions and velocities."""
        q_key, v_key = jax.random.split(rng)
        scale, nv = self._reset_noise_scale, self._physics.model.nv
        qpos = self._init_qpos + jax.random.uniform(q_key, self._init_qpos.shape, minval=-scale, maxval=scale)
        qvel = jax.random.uniform(v_key, (nv,), minval=-scale, maxval=scale)
        return self._at(at_pose(qpos, qvel))

    def set_state(self, state: State, qpos: Float[Array, " Q"], qvel: Float[Array, " V"]) -> State:
        """`state` moved to a pose, as Gymnasium's `set_state`; the solver starts cold."""
        return self._at(at_pose(jnp.asarray(qpos, state.obs.dtype), jnp.asarray(qvel, state.obs.dtype)))

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """One control interval of `dt` seconds. `done` is 1 where the task terminated; time limits are the rollout's."""
        before: Any = state.pipeline_state
        physics = self._physics.step(before, action)
        velocity = (physics.qpos[0] - before.qpos[0]) / self.dt
        healthy = self._is_healthy(physics)
        terms = {
            "reward_forward": self._forward_reward_weight * velocity,
            "reward_ctrl": -self._ctrl_cost_weight * jnp.square(action).sum(),
            "reward_survive": self._healthy_reward * (healthy | self._terminate_when_unhealthy).astype(velocity.dtype),
        }
        done = ~healthy & self._terminate_when_unhealthy
        return state.replace(
            pipeline_state=physics,
            obs=self._observation(physics),
            reward=terms["reward_forward"] + terms["reward_ctrl"] + terms["reward_survive"],
            done=done.astype(velocity.dtype),
            metrics={**state.metrics, **terms, "x_position": physics.qpos[0], "x_velocity": velocity},
        )

    def _at(self, physics: PhysicsState) -> State:
        zero = jnp.zeros((), physics.qpos.dtype)
        names = ("reward_forward", "reward_ctrl", "reward_survive", "x_position", "x_velocity")
        metrics = dict.fromkeys(names, zero) | {"x_position": physics.qpos[0]}
        return State(physics, self._observation(physics), zero, zero, metrics)  # pyright: ignore[reportArgumentType]

    def _observation(self, physics: PhysicsState) -> Array:
        return jnp.concatenate([physics.qpos[self._first_position :], jnp.clip(physics.qvel, -10, 10)])

    def _is_healthy(self, physics: PhysicsState) -> Array:
        def inside(x, bounds):
            return ((bounds[0] < x) & (x < bounds[1])).all()

        rest = jnp.concatenate([physics.qpos, physics.qvel])[2:]
        height, angle = physics.qpos[1], physics.qpos[2]
        return inside(rest, self._healthy_state_range) & inside(height, self._healthy_z_range) & inside(angle, self._healthy_angle_range)
