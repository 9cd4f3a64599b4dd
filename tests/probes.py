"""Small environments with known values."""

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State


def first(obs, pipeline_state=None, **metrics):
    """Return the state at the start of an episode."""
    zero = jnp.zeros(())
    return State(zero if pipeline_state is None else pipeline_state, obs, zero, zero, metrics)


class Probe(Env):
    """Base of the environments below: one action in ±1."""

    observation_size, action_size, backend = 1, 1, "none"
    action_range = (jnp.array([-1.0]), jnp.array([1.0]))


class Counter(Probe):
    """Reward is the number of the step; terminates after `length` steps.

    Each episode starts from a random fraction, so that two resets differ.
    """

    observation_size = 2

    def __init__(self, length: int = 10**9):
        self.length = length

    def reset(self, rng):
        obs = jnp.stack([jnp.zeros(()), jax.random.uniform(rng)])
        return first(obs, action=jnp.zeros(()))

    def step(self, state, action):
        count = state.obs[0] + 1
        done = (count >= self.length).astype(jnp.float32)
        obs = state.obs.at[0].set(count)
        return state.replace(obs=obs, reward=count, done=done, metrics={"action": action[0]})


class Fragile(Counter):
    """One part of the state turns to `value` at the third step, if the fraction is below ½.

    Of several parts, that fraction chooses one.
    """

    def __init__(self, value: float, *parts: str):
        super().__init__()
        self.value, self.parts = value, parts

    def step(self, state, action):
        after = super().step(state, action)
        chosen = jnp.where(after.obs[0] == 3, jnp.floor(2 * len(self.parts) * after.obs[1]), -1)
        broken = {
            part: jnp.where(chosen == i, self.value, getattr(after, part))
            for i, part in enumerate(self.parts)
        }
        return after.replace(**broken)


class Target(Probe):
    """One-step episodes with reward −(action − ½·side)², side = ±1 observed; the best is ½·side."""

    action_range = (jnp.array([-2.0]), jnp.array([2.0]))

    def reset(self, rng):
        return first(jax.random.rademacher(rng, (1,), jnp.float32))

    def step(self, state, action):
        return state.replace(reward=-((action[0] - 0.5 * state.obs[0]) ** 2), done=jnp.ones(()))


class Constant(Probe):
    """Reward 1 at every step, forever: the value is 1 / (1 − γ)."""

    def reset(self, rng):
        return first(jnp.ones(1))

    def step(self, state, action):
        return state.replace(reward=jnp.ones(()))
