"""Small environments with known values, for tests."""

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State


class Counter(Env):
    """Counts its steps; the reward is the count, and an episode terminates after `length` steps.

    Each episode starts from a random fraction, so that two resets differ.
    """

    observation_size, action_size, backend = 2, 1, "none"
    action_range = (jnp.array([-1.0]), jnp.array([1.0]))

    def __init__(self, length: int = 10**9):
        self.length = length

    def reset(self, rng):
        obs = jnp.stack([jnp.zeros(()), jax.random.uniform(rng)])
        zero = jnp.zeros(())
        return State(zero, obs, zero, zero, {"action": zero})

    def step(self, state, action):
        count = state.obs[0] + 1
        done = (count >= self.length).astype(jnp.float32)
        return state.replace(
            obs=state.obs.at[0].set(count), reward=count, done=done, metrics={"action": action[0]}
        )


class Fragile(Counter):
    """A counter of which one part turns to `value` at the third step, if the fraction it started from is below ½.

    Of several parts of the state, that fraction chooses one.
    """

    def __init__(self, value: float, *parts: str):
        super().__init__()
        self.value, self.parts = value, parts

    def step(self, state, action):
        after = super().step(state, action)
        chosen = jnp.where(after.obs[0] == 3, jnp.floor(2 * len(self.parts) * after.obs[1]), -1)
        return after.replace(
            **{
                part: jnp.where(chosen == i, self.value, getattr(after, part))
                for i, part in enumerate(self.parts)
            }
        )


class Target(Env):
    """One-step episodes: the reward is −(action − ½·side)², side = ±1 observed. The best mean action is ½·side."""

    observation_size, action_size, backend = 1, 1, "none"
    action_range = (jnp.array([-2.0]), jnp.array([2.0]))

    def reset(self, rng):
        zero = jnp.zeros(())
        return State(zero, jax.random.rademacher(rng, (1,), jnp.float32), zero, zero)

    def step(self, state, action):
        return state.replace(reward=-((action[0] - 0.5 * state.obs[0]) ** 2), done=jnp.ones(()))


class Delayed(Env):
    """Three steps of which only the last pays, 8: with γ = ½ the values are 2, 4, 8. The observation says which step it is."""

    observation_size, action_size, backend = 3, 1, "none"
    action_range = (jnp.array([-1.0]), jnp.array([1.0]))

    def reset(self, rng):
        zero = jnp.zeros(())
        return State(zero, jnp.array([1.0, 0, 0]), zero, zero)

    def step(self, state, action):
        last = state.obs[2]
        return state.replace(obs=jnp.roll(state.obs, 1) * (1 - last), reward=8 * last, done=last)


class Coin(Env):
    """One-step episodes that pay 1 or −1 by a coin that is not observed."""

    observation_size, action_size, backend = 1, 1, "none"
    action_range = (jnp.array([-1.0]), jnp.array([1.0]))

    def reset(self, rng):
        zero = jnp.zeros(())
        return State(jax.random.rademacher(rng, (), jnp.float32), jnp.ones(1), zero, zero)

    def step(self, state, action):
        return state.replace(reward=state.pipeline_state, done=jnp.ones(()))


class Constant(Env):
    """Reward 1 at every step, for ever: the value is 1 / (1 − γ) everywhere."""

    observation_size, action_size, backend = 1, 1, "none"
    action_range = (jnp.array([-1.0]), jnp.array([1.0]))

    def reset(self, rng):
        zero = jnp.zeros(())
        return State(zero, jnp.ones(1), zero, zero)

    def step(self, state, action):
        return state.replace(reward=jnp.ones(()))
