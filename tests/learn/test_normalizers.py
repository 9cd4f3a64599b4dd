"""Running scales: the plain statistics for ordinary data, and what a quarantined step or an outlier may do to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.learn import normalizers

SHAPE = (128, 16)
ALL_VALID = jnp.ones(SHAPE, bool)


def draws(distribution, count=12, seed=0):
    """`count` rollouts of ordinary data, one feature."""
    return jnp.asarray(distribution(np.random.default_rng(seed), (count, *SHAPE, 1)), jnp.float32)


@jax.jit
def followed(rollouts):
    """The statistics of observations after several rollouts."""
    start = normalizers.observations(rollouts.shape[-1])
    return jax.lax.scan(
        lambda state, rollout: (normalizers.observe(state, rollout, ALL_VALID), None),
        start,
        rollouts,
    )[0]


@jax.jit
def rescaled(rollouts):
    """The scale after several rollouts of rewards, γ = 0.99, in episodes of 100 steps on average."""
    ends = (jax.random.uniform(jax.random.key(1), rollouts.shape) < 0.01).astype(jnp.float32)

    def follow(scale, rollout):
        return normalizers.rescale(scale, *rollout, ALL_VALID, 0.99)[0], None

    return jax.lax.scan(follow, normalizers.reward_scale(SHAPE[1]), (rollouts, ends))[0]


def test_observation_statistics_are_those_of_all_samples_seen(key):
    obs = 3 * jax.random.normal(key, (4, 10, 5, 2)) + 7
    state = normalizers.observations(2)
    assert_array_equal(normalizers.normalize(state, obs[0]), jnp.clip(obs[0], -10, 10))
    for rollout in obs:
        state = normalizers.observe(state, rollout, jnp.ones((10, 5), bool))
    flat = np.asarray(obs).reshape(-1, 2)
    assert_allclose(
        normalizers.normalize(state, obs[0]),
        (np.asarray(obs[0]) - flat.mean(0)) / flat.std(0),
        rtol=1e-3,
        atol=1e-4,
    )


def test_without_statistics_observations_pass_untouched():
    obs = jnp.array([[1e4, -37.0, 0.5]])
    assert_array_equal(normalizers.normalize(None, obs), obs)


def test_rewards_are_divided_by_the_standard_deviation_of_the_discounted_return(key):
    reward = jax.random.normal(key, (50, 3)) + 1
    done = jax.random.bernoulli(key, 0.1, (50, 3)).astype(jnp.float32)
    scale, scaled = normalizers.rescale(
        normalizers.reward_scale(3), reward, done, jnp.ones((50, 3), bool), 0.9
    )
    trail, running = np.zeros((50, 3)), np.zeros(3)
    for t in range(50):
        running = 0.9 * running + np.asarray(reward[t])
        trail[t], running = running, running * (1 - np.asarray(done[t]))
    assert_allclose(scaled, np.asarray(reward) / trail.std(), rtol=1e-4)
    assert_allclose(scale.discounted, running, rtol=1e-4)


def test_a_quarantined_step_does_not_count_in_the_reward_scale():
    # one world, γ = 0: the returns are the rewards 1, 3 and, in quarantine, 0; the standard deviation of 1 and 3 is 1
    reward, valid = jnp.array([[1.0], [0.0], [3.0]]), jnp.array([[True], [False], [True]])
    scale, scaled = normalizers.rescale(
        normalizers.reward_scale(1), reward, 1.0 - valid, valid, 0.0
    )
    assert_allclose(scale.returns.std, 1.0, rtol=1e-6)
    assert_allclose(scaled, reward, rtol=1e-6)


def test_a_quarantined_step_does_not_count_in_the_observations():
    obs, valid = jnp.array([[[1.0]], [[50.0]], [[3.0]]]), jnp.array([[True], [False], [True]])
    state = normalizers.observe(normalizers.observations(1), obs, valid)
    assert_allclose([state.mean, state.std], [[2.0], [1.0]], rtol=1e-6)


ORDINARY = {
    "normal": lambda rng, shape: rng.normal(size=shape),
    "far from zero": lambda rng, shape: 100 + rng.normal(size=shape),
    "Student's t with 3 degrees of freedom": lambda rng, shape: rng.standard_t(3, shape),
    "log-normal": lambda rng, shape: rng.lognormal(size=shape),
    "two values": lambda rng, shape: 1.0 * (rng.random(shape) < 0.3),
    "one in a thousand": lambda rng, shape: 100.0 * (rng.random(shape) < 1e-3),
    "constant": lambda rng, shape: np.full(shape, 3.0),
}


@pytest.mark.parametrize("name", ORDINARY)
def test_for_ordinary_data_the_statistics_are_the_plain_ones_however_heavy_their_tails(name):
    rollouts = draws(ORDINARY[name])
    state, flat = followed(rollouts), np.asarray(rollouts, np.float64)
    assert_allclose(state.mean[0], flat.mean(), rtol=1e-4, atol=1e-4)
    assert_allclose(state.std[0], max(flat.std(), 1e-6), rtol=1e-3)


@pytest.mark.parametrize("size", [1e6, -1e20])
@pytest.mark.parametrize("at", [0, 1, 11])
def test_one_observation_out_of_all_proportion_at_most_doubles_the_variance(at, size):
    rollouts = draws(ORDINARY["normal"])
    state = followed(rollouts.at[at, 40, 3, 0].set(size))
    assert abs(state.mean[0]) < 0.05
    assert 0.99 < state.std[0] < 1.01 * 2**0.5
    assert_allclose(normalizers.normalize(state, jnp.ones(1)), 1.0, atol=0.35)


@pytest.mark.parametrize("size", [1e6, -1e20])
@pytest.mark.parametrize("at", [0, 1, 11])
def test_one_reward_out_of_all_proportion_at_most_doubles_the_variance_of_the_returns(at, size):
    rewards = draws(ORDINARY["normal"])[..., 0]
    usual, spoilt = (
        rescaled(rewards).returns.std,
        rescaled(rewards.at[at, 40, 3].set(size)).returns.std,
    )
    assert 0.95 * usual < spoilt < 1.5 * usual


def test_a_few_different_outliers_in_the_first_rollout_do_no_more():
    rollouts = draws(ORDINARY["normal"], count=1)
    rollouts = rollouts.at[0, 40:45, 3, 0].set(jnp.array([1e2, 1e4, 1e8, 1e16, 1e20]))
    assert followed(rollouts).std[0] < 1.1 * 6**0.5  # each adds at most as much as all the others


def test_the_scale_follows_when_all_of_the_data_grow():
    small, large = (
        draws(ORDINARY["normal"], count=20),
        1e4 * draws(ORDINARY["normal"], count=4, seed=2),
    )
    state, plain = (
        followed(jnp.concatenate([small, large])),
        np.asarray(jnp.concatenate([small, large]), np.float64).std(),
    )
    assert 0.7 * plain < state.std[0] < plain


def test_a_rare_event_beside_small_noise_is_counted_in_full_once_it_has_recurred():
    def seldom(rng, shape):
        return 0.01 * rng.normal(size=shape) + 100.0 * (rng.random(shape) < 1e-3)

    rollouts = draws(seldom, count=60)
    assert_allclose(followed(rollouts).std[0], np.asarray(rollouts, np.float64).std(), rtol=0.15)
