"""Running statistics: the plain ones for ordinary data; masks and outliers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.learn.normalizers import (
    init_obs_stats,
    init_reward_scale,
    normalize,
    scale_rewards,
    update_obs_stats,
)

SHAPE = (128, 16)
ALL = jnp.ones(SHAPE, bool)


def draws(distribution):
    """Twelve rollouts of one feature."""
    samples = distribution(np.random.default_rng(0), (12, *SHAPE, 1))
    return jnp.asarray(samples, jnp.float32)


@jax.jit
def obs_stats(rollouts):
    def update(statistics, rollout):
        return update_obs_stats(statistics, rollout, ALL), None

    return jax.lax.scan(update, init_obs_stats(rollouts.shape[-1]), rollouts)[0]


def test_observations_are_normalized_by_all_samples_seen(key):
    obs = 3 * jax.random.normal(key, (4, 10, 5, 2)) + 7
    state = init_obs_stats(2)
    assert_array_equal(normalize(state, obs[0]), jnp.clip(obs[0], -10, 10))
    for rollout in obs:
        state = update_obs_stats(state, rollout, jnp.ones((10, 5), bool))
    flat = np.asarray(obs).reshape(-1, 2)
    want = (np.asarray(obs[0]) - flat.mean(0)) / flat.std(0)
    assert_allclose(normalize(state, obs[0]), want, rtol=1e-3, atol=1e-4)
    assert_array_equal(normalize(None, obs), obs)


def test_rewards_are_divided_by_the_std_of_discounted_returns(key):
    reward = jax.random.normal(key, (50, 3)) + 1
    done = jax.random.bernoulli(key, 0.1, (50, 3)).astype(jnp.float32)
    mask = jnp.ones((50, 3), bool)
    scale, scaled = scale_rewards(init_reward_scale(3), reward, done, mask, 0.9)
    returns, running = np.zeros((50, 3)), np.zeros(3)
    for t in range(50):
        running = 0.9 * running + np.asarray(reward[t])
        returns[t], running = running, running * (1 - np.asarray(done[t]))
    assert_allclose(scaled, np.asarray(reward) / returns.std(), rtol=1e-4)
    assert_allclose(scale.discounted, running, rtol=1e-4)


def test_a_masked_step_counts_in_no_statistic():
    # the standard deviation of 1 and 3 is 1; with γ = 0 the returns are the rewards
    mask = jnp.array([[True], [False], [True]])
    reward, obs = jnp.array([[1.0], [0.0], [3.0]]), jnp.array([[[1.0]], [[50.0]], [[3.0]]])
    scale, scaled = scale_rewards(init_reward_scale(1), reward, 1.0 - mask, mask, 0.0)
    assert_allclose(scale.returns.std, 1.0, rtol=1e-6)
    assert_allclose(scaled, reward, rtol=1e-6)
    state = update_obs_stats(init_obs_stats(1), obs, mask)
    assert_allclose([state.mean, state.std], [[2.0], [1.0]], rtol=1e-6)


ORDINARY = {
    "normal": lambda rng, shape: rng.normal(size=shape),
    "Student's t with 3 degrees of freedom": lambda rng, shape: rng.standard_t(3, shape),
    "one in a thousand": lambda rng, shape: 100.0 * (rng.random(shape) < 1e-3),
    "constant": lambda rng, shape: np.full(shape, 3.0),
}


@pytest.mark.parametrize("name", ORDINARY)
def test_ordinary_data_have_the_plain_statistics(name):
    rollouts = draws(ORDINARY[name])
    state, flat = obs_stats(rollouts), np.asarray(rollouts, np.float64)
    assert_allclose(state.mean[0], flat.mean(), rtol=1e-4, atol=1e-4)
    assert_allclose(state.std[0], max(flat.std(), 1e-6), rtol=1e-3)


@pytest.mark.parametrize(("at", "size"), [(0, -1e20), (11, 1e6)])
def test_one_outlier_at_most_doubles_a_variance(at, size):
    rollouts = draws(ORDINARY["normal"])
    state = obs_stats(rollouts.at[at, 40, 3, 0].set(size))
    assert abs(state.mean[0]) < 0.05
    assert 0.99 < state.std[0] < 1.01 * 2**0.5
