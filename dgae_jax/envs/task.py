"""What Gymnasium's MuJoCo tasks share, as a `brax.envs.base.Env` over any physics engine.

What differs between tasks is a method, what differs between versions a line that names the version. The time limit
belongs to the rollout, not to the task.
"""

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
from dgae_jax.physics.registry import make_physics


def load_spec(filename: str) -> mujoco.MjSpec:
    """A model file of the installed gymnasium package, read without importing gymnasium."""
    spec = find_spec("gymnasium")
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(
            "the model files come from the package gymnasium, which is not installed"
        )
    path = Path(spec.submodule_search_locations[0]) / "envs" / "mujoco" / "assets" / filename
    return mujoco.MjSpec.from_file(str(path))


class Task(Env):
    """Move forward: the frame that the four tasks share.

    Actions are the actuators' controls; the control cost takes them as given, MuJoCo clips them. `metrics` hold the
    reward's terms, the position [m] and the velocity [m/s].
    """

    FILE: ClassVar[dict[str, str]]
    """Model file by version."""
    FRAME_SKIP: ClassVar[int] = 4
    NAME: ClassVar[str]
    """Gymnasium's name, without the version."""
    AXES: ClassVar[int]
    """Leading positions that the observation leaves out: one for x, two for x and y."""
    VELOCITY_LIMIT: ClassVar[float] = inf
    """Observed velocities are clipped to ± this."""
    TERMS: ClassVar[tuple[str, ...]]
    """Names of the reward's terms."""

    def __init__(
        self,
        physics: Physics,
        version: str,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float,
        reset_noise_scale: float,
        exclude_current_positions_from_observation: bool = True,
    ):
        self._physics, self._version = physics, version
        self._forward_reward_weight = forward_reward_weight
        self._ctrl_cost_weight = ctrl_cost_weight
        self._reset_noise_scale = reset_noise_scale
        self._first_position = self.AXES * exclude_current_positions_from_observation
        self._init_qpos = jnp.asarray(physics.model.qpos0)

    @classmethod
    def make(cls, physics: str, version: str, **parameters) -> "Task":
        """The task over the engine named `physics`."""
        spec, reads = load_spec(cls.FILE[version]), cls.reads(version, **parameters)
        return cls(make_physics(physics, spec, cls.FRAME_SKIP, reads), version, **parameters)

    # ---- what a task may say differently ----

    @staticmethod
    def reads(version: str, **parameters) -> Reads:
        """What reward and observation use besides positions and velocities."""
        return Reads()

    def _terms(
        self, before: PhysicsState, after: PhysicsState, action: Array, velocity: Array
    ) -> dict[str, Array]:
        """The reward's terms, in the order of `TERMS`; their sum is the reward."""
        return {
            "reward_forward": self._forward_reward_weight * velocity[0],
            "reward_ctrl": -self._ctrl_cost_weight * jnp.square(action).sum(),
        }

    def _is_over(self, physics: PhysicsState) -> Bool[Array, ""]:
        return jnp.asarray(False)

    def _position(self, physics: PhysicsState) -> Float[Array, " A"]:
        """Where the reward looks: x, or x and y [m]."""
        return physics.qpos[: self.AXES]

    def _velocity_noise(self, key: Array) -> Float[Array, " V"]:
        return self._uniform(key, self._physics.model.nv)

    def _observation(self, physics: PhysicsState) -> Float[Array, " O"]:
        velocity = jnp.clip(physics.qvel, -self.VELOCITY_LIMIT, self.VELOCITY_LIMIT)
        return jnp.concatenate([physics.qpos[self._first_position :], velocity])

    # ---- the environment ----

    @property
    def dt(self) -> float:
        """Seconds of simulated time per environment step."""
        return self._physics.model.opt.timestep * self.FRAME_SKIP

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        nq, nv = self._physics.model.nq, self._physics.model.nv
        return jax.eval_shape(
            lambda: self._observation(self._physics.init(jnp.zeros(nq), jnp.zeros(nv)))
        ).shape[0]

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
        """A fresh random pose: noise of `reset_noise_scale` on positions and velocities."""
        q_key, v_key = jax.random.split(rng)
        qpos = self._init_qpos + self._uniform(q_key, self._physics.model.nq)
        return self._at(self._physics.init(qpos, self._velocity_noise(v_key)))

    def set_state(self, state: State, qpos: ArrayLike, qvel: ArrayLike) -> State:
        """`state` moved to a pose, qpos [Q] and qvel [V], as Gymnasium's `set_state`; the solver starts cold."""
        return self._at(
            self._physics.init(
                jnp.asarray(qpos, state.obs.dtype), jnp.asarray(qvel, state.obs.dtype)
            )
        )

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """One control interval of `dt` seconds. `done` is 1 where the task terminated; time limits are the rollout's."""
        before: Any = state.pipeline_state
        after = self._physics.step(before, action)
        velocity = (self._position(after) - self._position(before)) / self.dt
        terms = self._terms(before, after, action, velocity)
        return state.replace(
            pipeline_state=after,
            obs=self._observation(after),
            reward=sum(terms.values()),
            done=self._is_over(after).astype(velocity.dtype),
            metrics={
                **state.metrics,
                **terms,
                **self._whereabouts(self._position(after), velocity),
            },
        )

    def _at(self, physics: PhysicsState) -> State:
        zero, position = jnp.zeros((), physics.qpos.dtype), self._position(physics)
        metrics = dict.fromkeys(self.TERMS, zero) | self._whereabouts(
            position, jnp.zeros_like(position)
        )
        return State(physics, self._observation(physics), zero, zero, metrics)  # pyright: ignore[reportArgumentType]

    def _whereabouts(self, position: Array, velocity: Array) -> dict[str, Array]:
        named = {"position": position, "velocity": velocity}
        return {
            f"{axis}_{what}": value[i]
            for what, value in named.items()
            for i, axis in enumerate("xy"[: self.AXES])
        }

    def _uniform(self, key: Array, size: int) -> Array:
        return jax.random.uniform(
            key, (size,), minval=-self._reset_noise_scale, maxval=self._reset_noise_scale
        )


class HealthyTask(Task):
    """A task that pays for staying healthy and ends when the body no longer is."""

    TERMS = ("reward_forward", "reward_ctrl", "reward_survive")

    def __init__(
        self,
        physics: Physics,
        version: str,
        *,
        healthy_reward: float = 1.0,
        terminate_when_unhealthy: bool = True,
        **parameters,
    ):
        super().__init__(physics, version, **parameters)
        self._healthy_reward = healthy_reward
        self._terminate_when_unhealthy = terminate_when_unhealthy

    def _is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        raise NotImplementedError

    def _is_over(self, physics: PhysicsState) -> Bool[Array, ""]:
        return ~self._is_healthy(physics) & self._terminate_when_unhealthy

    def _terms(self, before, after, action, velocity):
        healthy = self._is_healthy(after)
        if self._version == "v4":  # pays on the terminating step too
            healthy = healthy | self._terminate_when_unhealthy
        survive = self._healthy_reward * healthy.astype(velocity.dtype)
        return {**super()._terms(before, after, action, velocity), "reward_survive": survive}
