"""Noise for deterministic tasks, so that there is a value distribution to model."""

from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array

from dgae_jax.envs.base import Env, State, Wrapper, restart
from dgae_jax.envs.task import Task


class Noisy(Wrapper):
    """A task with normal noise of given standard deviations, drawn from the key of its reset.

    The policy sees noise and the reward is paid with it; the physics underneath stays exact.
    `initial` is the noise on positions and velocities at a reset, for our own tasks.
    """

    def __init__(
        self,
        env: Env,
        *,
        reward: float = 0.0,
        action: float = 0.0,
        observation: float = 0.0,
        initial: float = 0.0,
    ):
        super().__init__(env)
        if initial and not isinstance(env, Task):
            raise ValueError("noise on the initial state is for our own tasks")
        self._reward, self._action = reward, action
        self._observation, self._initial = observation, initial

    def reset(self, rng: Array) -> State:
        """Return the task's own start, moved and seen with noise."""
        return self._begin(rng, self.env.reset)

    def restart(self, state: State, rng: Array, done: Array) -> State:
        """Restart as `envs.base.restart`."""
        return self._begin(rng, lambda key: restart(self.env, state, key, done))

    def _begin(self, rng: Array, reset: Callable[[Array], State]) -> State:
        key, q_key, v_key, o_key, r_key = jax.random.split(rng, 5)
        state = reset(r_key)
        if self._initial:
            physics: Any = state.pipeline_state
            moved = (
                x + self._initial * jax.random.normal(k, x.shape)
                for k, x in ((q_key, physics.qpos), (v_key, physics.qvel))
            )
            state = self.env.set_state(state, *moved)
        return self._observed(state, o_key, key)

    def step(self, state: State, action: Array) -> State:
        """Step the task from its true observation."""
        key, a_key, r_key, o_key = jax.random.split(state.info["noise_key"], 4)
        action = action + self._action * jax.random.normal(a_key, action.shape)
        after = self.env.step(state.replace(obs=state.info["true_obs"]), action)
        after = after.replace(reward=after.reward + self._reward * jax.random.normal(r_key))
        return self._observed(after, o_key, key)

    def _observed(self, state: State, key: Array, next_key: Array) -> State:
        true: Any = state.obs
        obs = true + self._observation * jax.random.normal(key, true.shape)
        return state.replace(obs=obs, info={**state.info, "true_obs": true, "noise_key": next_key})
