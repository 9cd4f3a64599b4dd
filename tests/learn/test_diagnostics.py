import jax
import jax.numpy as jnp
from numpy.testing import assert_allclose

from dgae_jax.learn import diagnostics
from dgae_jax.maths.transport import quantile_midpoints


def test_a_perfect_critic_of_a_normal_reward_is_calibrated(key):
    # one-step episodes with a standard normal reward: quantiles Φ⁻¹(τ), outcome the reward
    k, shape = 64, (500, 8)
    reward = jax.random.normal(key, shape)
    quantiles = jnp.broadcast_to(jax.scipy.stats.norm.ppf(quantile_midpoints(k)), (*shape, k))
    zero = jnp.zeros(shape)
    got = diagnostics.of_critic(reward, zero, zero, quantiles, jnp.zeros_like(quantiles))
    assert_allclose(got["critic/coverage_90"], 0.9, atol=0.015)
    assert_allclose([got["critic/pit_mean"], got["critic/pit_std"]], [0.5, 1 / 12**0.5], atol=0.015)
    assert_allclose(
        got["critic/wasserstein"], 2 / jnp.pi**0.5, atol=0.03
    )  # E|X − Y| of two standard normals
    assert got["critic/crossing"] == 0


def test_the_bootstrap_at_the_end_of_a_rollout_inflates_coverage(key):
    # a perfect critic of independent N(0, 1) rewards, γ = 0.99: G ~ N(0, 1/(1 − γ²)); m steps before the rollout's end the outcome has only
    # the share 1 − γ²ᵐ of that variance, so the interval of 90 % holds 2Φ(1.645/√(1 − γ²ᵐ)) − 1, on average 0.953 over m = 1 … 128
    gamma, k, shape = 0.99, 64, (128, 400)
    quantiles = jax.scipy.stats.norm.ppf(quantile_midpoints(k)) / (1 - gamma**2) ** 0.5
    quantiles = jnp.broadcast_to(quantiles, (*shape, k))
    got = diagnostics.of_critic(
        jax.random.normal(key, shape), jnp.full(shape, gamma), jnp.ones(shape), quantiles, quantiles
    )
    assert_allclose(got["critic/coverage_90"], 0.953, atol=0.015)


def test_similar_means_and_different_shapes_are_counted_and_shifts_are_not():
    narrow, wide, shifted = jnp.array([-1.0, 1.0]), jnp.array([-3.0, 3.0]), jnp.array([1.0, 3.0])
    quantiles, next_quantiles = (
        jnp.stack([narrow, narrow, narrow])[:, None],
        jnp.stack([wide, shifted, wide + 0.5])[:, None],
    )
    one, zero = jnp.ones((3, 1)), jnp.zeros((3, 1))
    # d = 0 against W₁ = 2, d = W₁ = 2, d = 0.5 against W₁ = 2
    assert_allclose(
        diagnostics.of_critic(zero, one, zero, quantiles, next_quantiles)["critic/similar_means"],
        1 / 3,
    )


def test_crossing_counts_neighbours_in_the_wrong_order():
    quantiles = jnp.array([[[0.0, 1.0, 0.5, 2.0]]])
    got = diagnostics.of_critic(*(jnp.zeros((1, 1)) for _ in range(3)), quantiles, quantiles)
    assert_allclose(got["critic/crossing"], 1 / 3)
