"""Common base of Gymnasium's MuJoCo tasks, a `brax.envs.base.Env` over any physics engine.

A difference between tasks is a method, one between versions a line that names the version. The time
limit belongs to the rollout, not to the task.
"""

from dataclasses import KW_ONLY, dataclass
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, ArrayLike, Bool, Float

from dgae_jax.envs.base import Env, State
from dgae_jax.physics.engine import Physics, PhysicsState, Reads


def load_spec(filename: str) -> mujoco.MjSpec:
    """Read one of Gymnasium's model files, as `hopper.xml`, without importing gymnasium."""
    package: Any = find_spec("gymnasium")
    path = Path(package.origin).parent / "envs" / "mujoco" / "assets" / filename
    return mujoco.MjSpec.from_file(str(path))


@dataclass(eq=False)
class Task(Env):
    """Move forward, with a cost on the controls.

    Actions are the actuators' controls; the control cost takes them as given, MuJoCo clips them.
    `metrics` hold the terms of the reward, the position [m] and the velocity [m/s]. The fields are
    Gymnasium's parameters, by its names.
    """

    physics: Physics
    version: str
    _: KW_ONLY
    forward_reward_weight: float = 1.0
    ctrl_cost_weight: float
    reset_noise_scale: float
    exclude_current_positions_from_observation: bool = True

    FILE: ClassVar[dict[str, str]]
    """Model file by version."""
    FRAME_SKIP: ClassVar[int] = 4
    NAME: ClassVar[str]
    """Gymnasium's name, without the version."""
    AXES: ClassVar[int]
    """Leading positions that the observation excludes: one for x, two for x and y."""
    VELOCITY_LIMIT: ClassVar[float] = inf
    """Bound on observed velocities."""

    # ---- to override in a task ----

    @staticmethod
    def reads(version: str, **parameters) -> Reads:
        """Return the quantities that reward and observation need besides `qpos` and `qvel`."""
        return Reads()

    def _terms(
        self, before: PhysicsState, after: PhysicsState, action: Array, velocity: Array
    ) -> dict[str, Array]:
        """Return the terms of the reward; their sum is the reward."""
        return {
            "reward_forward": self.forward_reward_weight * velocity[0],
            "reward_ctrl": -self.ctrl_cost_weight * jnp.square(action).sum(),
        }

    def _is_over(self, state: PhysicsState) -> Bool[Array, ""]:
        return jnp.asarray(False)

    def _position(self, state: PhysicsState) -> Float[Array, " A"]:
        """Return the rewarded position: x, or x and y [m]."""
        return state.qpos[: self.AXES]

    def _velocity_noise(self, key: Array) -> Float[Array, " V"]:
        return self._uniform(key, self.physics.model.nv)

    def _observation(self, state: PhysicsState) -> Float[Array, " O"]:
        velocity = jnp.clip(state.qvel, -self.VELOCITY_LIMIT, self.VELOCITY_LIMIT)
        first = self.AXES * self.exclude_current_positions_from_observation
        return jnp.concatenate([state.qpos[first:], velocity])

    # ---- Brax's contract ----

    @property
    def dt(self) -> float:
        """Seconds of simulated time per environment step."""
        return self.physics.model.opt.timestep * self.FRAME_SKIP

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        model = self.physics.model
        state = self.physics.init(jnp.zeros(model.nq), jnp.zeros(model.nv))
        return jax.eval_shape(self._observation, state).shape[0]

    @property
    def action_size(self) -> int:
        """Number of actuators."""
        return self.physics.model.nu

    @property
    def action_range(self) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
        """The actuators' lowest and highest control."""
        low, high = self.physics.model.actuator_ctrlrange.T
        return jnp.asarray(low), jnp.asarray(high)

    @property
    def backend(self) -> str:
        """Name of the physics."""
        return self.physics.name

    def reset(self, rng: Array) -> State:
        """Return a random pose: noise of `reset_noise_scale` on positions and velocities."""
        q_key, v_key = jax.random.split(rng)
        model = self.physics.model
        qpos = jnp.asarray(model.qpos0) + self._uniform(q_key, model.nq)
        return self._at(self.physics.init(qpos, self._velocity_noise(v_key)))

    def set_state(self, state: State, qpos: ArrayLike, qvel: ArrayLike) -> State:
        """Return `state` moved to a pose, as Gymnasium's `set_state`; the solver starts cold.

        Args:
            state: any state of the task.
            qpos: positions [Q].
            qvel: velocities [V].
        """
        qpos, qvel = (jnp.asarray(x, state.obs.dtype) for x in (qpos, qvel))
        return self._at(self.physics.init(qpos, qvel))

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Advance one control interval of `dt` seconds; `done` is 1 where the task terminated."""
        before: Any = state.pipeline_state
        after = self.physics.step(before, action)
        position = self._position(after)
        velocity = (position - self._position(before)) / self.dt
        terms = self._terms(before, after, action, velocity)
        return state.replace(
            pipeline_state=after,
            obs=self._observation(after),
            reward=sum(terms.values()),
            done=self._is_over(after).astype(velocity.dtype),
            metrics={**state.metrics, **terms, **self._motion_metrics(position, velocity)},
        )

    def _at(self, physics_state: PhysicsState) -> State:
        position, zero = self._position(physics_state), jnp.zeros((), physics_state.qpos.dtype)
        velocity, action = jnp.zeros_like(position), jnp.zeros(self.action_size)
        terms = self._terms(physics_state, physics_state, action, velocity)
        metrics = dict.fromkeys(terms, zero) | self._motion_metrics(position, velocity)
        obs = self._observation(physics_state)
        return State(physics_state, obs, zero, zero, metrics)  # pyright: ignore

    def _motion_metrics(self, position: Array, velocity: Array) -> dict[str, Array]:
        named, axes = (("position", position), ("velocity", velocity)), "xy"[: self.AXES]
        return {f"{axis}_{name}": x[i] for name, x in named for i, axis in enumerate(axes)}

    def _uniform(self, key: Array, size: int) -> Array:
        scale = self.reset_noise_scale
        return jax.random.uniform(key, (size,), minval=-scale, maxval=scale)


@dataclass(eq=False)
class HealthyTask(Task):
    """A task with a reward for being healthy, which ends when the body is not."""

    healthy_reward: float = 1.0
    terminate_when_unhealthy: bool = True

    def _is_healthy(self, state: PhysicsState) -> Bool[Array, ""]:
        raise NotImplementedError

    def _is_over(self, state: PhysicsState) -> Bool[Array, ""]:
        return ~self._is_healthy(state) & self.terminate_when_unhealthy

    def _terms(self, before, after, action, velocity):
        healthy = self._is_healthy(after)
        if self.version == "v4":  # pays on the terminating step too
            healthy = healthy | self.terminate_when_unhealthy
        survive = self.healthy_reward * healthy.astype(velocity.dtype)
        return {**super()._terms(before, after, action, velocity), "reward_survive": survive}
