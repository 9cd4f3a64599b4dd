"""Rollouts: time limits and ends, true successors, fresh episodes, masks."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.learn.rollout import rollout, start
from tests.probes import Counter, Fragile


def act(key, obs):
    return jnp.full((*obs.shape[:-1], 1), 3.0), jnp.zeros(obs.shape[:-1])


def run(env, key, *, num_envs=4, num_steps=12, episode_length=5, act=act):
    start_key, key = jax.random.split(key)
    episodes = start(env, jax.random.split(start_key, num_envs))
    keys = jax.random.split(key, (num_steps, num_envs))
    return rollout(env, act, episodes, keys, episode_length=episode_length)


@cache
def counter():
    """12 steps in 4 envs, with a time limit of 5."""
    return run(Counter(), jax.random.key(0))


def all_finite(tree):
    return all(np.isfinite(x).all() for x in tree)


def test_a_time_limit_truncates_and_the_end_of_the_task_terminates(key):
    _, limited = counter()
    assert not limited.terminated.any()
    assert_array_equal(np.flatnonzero(limited.truncated[:, 0]), [4, 9])
    _, ended = run(Counter(length=5), key, episode_length=5)  # at the limit too
    assert not ended.truncated.any()
    assert_array_equal(np.flatnonzero(ended.terminated[:, 0]), [4, 9])


def test_next_obs_is_the_true_successor():
    _, step = counter()
    continues = ~np.asarray(step.truncated)[:-1]
    following = np.asarray(step.obs)[1:]
    assert_array_equal(np.asarray(step.next_obs)[:-1][continues], following[continues])
    assert_array_equal(step.next_obs[4, :, 0], 5)  # where the episode ended, not the reset
    assert_array_equal(step.next_obs[4, :, 1], step.obs[4, :, 1])
    assert_array_equal(step.obs[5, :, 0], 0)


def test_every_episode_starts_from_a_random_state_of_its_own():
    _, step = counter()
    starts = np.asarray(step.obs[[0, 5, 10], :, 1]).ravel()
    assert len(set(starts.tolist())) == 12


def test_episode_returns_are_undiscounted_and_nan_before_the_first_end(key):
    episodes, _ = run(Counter(), key, num_steps=4)
    assert jnp.isnan(episodes.last_total).all()
    episodes, _ = counter()  # the third episode is at its second step
    assert_allclose(episodes.last_total, 1 + 2 + 3 + 4 + 5)
    assert_allclose(episodes.last_steps, 5)
    assert_allclose(episodes.total, 1 + 2)
    assert_array_equal(episodes.steps, 2)


def test_actions_are_clipped_before_they_act_and_recorded_as_sampled():
    episodes, step = counter()
    assert_array_equal(step.action, 3.0)
    assert_array_equal(episodes.env.metrics["action"][0], 1.0)


@pytest.mark.parametrize(
    ("part", "value"), [("pipeline_state", jnp.nan), ("reward", jnp.inf), ("obs", jnp.nan)]
)
def test_a_non_finite_env_is_masked_and_starts_afresh(part, value, key):
    env = Fragile(value, part)
    episodes, step = run(env, key, num_envs=16, num_steps=4, episode_length=100)
    broken = np.asarray(step.obs[0, :, 1] < 0.5)
    assert 0 < broken.sum() < 16
    assert_array_equal(step.mask[2], ~broken)
    assert_array_equal(step.terminated[2], broken)
    assert_array_equal(step.reward[2], np.where(broken, 0, 3))
    assert_array_equal(step.obs[3, :, 0], np.where(broken, 0, 3))
    assert_array_equal(episodes.last_total, np.where(broken, 1 + 2, np.nan))
    assert int(episodes.nonfinite.sum()) == broken.sum()
    assert all_finite(step)
    assert all_finite((episodes.env.obs, episodes.env.reward, episodes.total))
    _, action = episodes.incident  # of the last masked step
    assert_array_equal(action[:, 0], np.where(broken, 3, 0))


def test_a_non_finite_action_is_masked_too(key):
    def sometimes(key, obs):
        action = jnp.where((obs[:, :1] == 2) & (obs[:, 1:] < 0.5), jnp.nan, 0.5)
        return action, action[:, 0]

    options = {"num_envs": 16, "num_steps": 4, "episode_length": 100}
    episodes, step = run(Counter(), key, act=sometimes, **options)
    assert 0 < int(episodes.nonfinite.sum()) == int(step.terminated[2].sum()) < 16
    assert all_finite(step)
    assert_array_equal(jnp.isnan(episodes.incident[1][:, 0]), episodes.nonfinite > 0)


def test_an_env_depends_on_its_own_keys_alone(key):
    def drawn(keys, obs):
        return jax.vmap(jax.random.normal, (0, None))(keys, (1,)), jnp.zeros(len(keys))

    start_keys, keys = jax.random.split(key, 6), jax.random.split(key, (7, 6))

    def run(chosen):
        episodes = start(Counter(), start_keys[chosen])
        return rollout(Counter(), drawn, episodes, keys[:, chosen], episode_length=5)

    (whole, all_steps), (half, steps) = run(slice(None)), run(slice(3, None))
    whole, half = (x._replace(incident=()) for x in (whole, half))
    jax.tree.map(lambda a, b: assert_array_equal(a[3:], b), whole, half)
    jax.tree.map(lambda a, b: assert_array_equal(a[:, 3:], b), all_steps, steps)
