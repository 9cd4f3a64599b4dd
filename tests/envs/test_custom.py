"""Environments given as objects: defaults, and refusals before anything is compiled."""

import jax.numpy as jnp
import pytest
from brax.envs.wrappers.training import EpisodeWrapper
from numpy.testing import assert_array_equal

import dgae_jax as dg
from dgae_jax.envs.custom import with_range
from dgae_jax.envs.registry import custom_env
from dgae_jax.learn.rollout import rollout, start
from tests.probes import Counter


class Bare(Counter):
    """A counter without a range of its actions."""

    @property
    def action_range(self):
        raise AttributeError


class TwoAxes(Bare):
    observation_size = 3


class Named(Bare):
    def reset(self, rng):
        state = super().reset(rng)
        return state.replace(obs={"state": state.obs})

    def step(self, state, action):
        return state


class Replacing(Bare):
    """Its steps replace fields of the state."""

    def __init__(self, **fields):
        super().__init__()
        self.fields = fields

    def step(self, state, action):
        return super().step(state, action).replace(**self.fields)


def act(keys, obs):
    return jnp.zeros((len(obs), 1)), jnp.zeros(len(obs))


def made(env):
    with custom_env(env) as name:
        return dg.make_env(name)


def test_actions_lie_in_the_unit_box_by_default():
    assert_array_equal(made(Bare()).action_range, [[-1], [1]])
    wide = type("Wide", (Counter,), {"action_range": (-2.0, 3.0)})()
    assert_array_equal(made(wide).action_range, [[-2], [3]])
    assert with_range(wide) is wide


@pytest.mark.parametrize(
    ("env", "reason"),
    [
        (3, "int is not a brax.envs.base.Env"),
        (TwoAxes(), r"the observation of its reset has shape float32\[2\]"),
        (Named(), r"the observation of its reset has shape state: float32\[2\]"),
        (Replacing(info={"x": jnp.zeros(3)}), r"its step turns state.info\['x'\] from nothing"),
        (Replacing(reward=jnp.int32(1)), "the reward of its step is .*int32"),
        (Replacing(wind=1), r"its step cannot be compiled by JAX \(TypeError: .*wind"),
    ],
)
def test_invalid_env_is_refused_with_the_reason(env, reason):
    with pytest.raises(ValueError, match=f"^{reason}"):
        made(env)


def test_truncation_of_the_env_starts_a_fresh_episode(key):
    env = made(EpisodeWrapper(Counter(), 5, 1))
    _, step = rollout(env, act, start(env, key[None]), jnp.tile(key, (12, 1)), episode_length=100)
    assert_array_equal(jnp.flatnonzero(step.truncated), [4, 9])
    assert not step.terminated.any()
    assert_array_equal(step.next_obs[:, 0, 0], [1, 2, 3, 4, 5, 1, 2, 3, 4, 5, 1, 2])
