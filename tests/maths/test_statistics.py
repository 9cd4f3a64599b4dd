import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import dgae_jax as dg


def test_explained_variance_is_one_for_the_truth_and_zero_for_a_constant():
    y = jnp.array([1.0, 2.0, 4.0])
    assert_allclose(dg.explained_variance(y, y), 1.0)
    assert_allclose(
        dg.explained_variance(y + 3, y), 1.0, atol=1e-6
    )  # variance does not see a constant offset
    assert_allclose(dg.explained_variance(jnp.full(3, 7.0), y), 0.0, atol=1e-6)
    assert jnp.isnan(dg.explained_variance(y, jnp.ones(3)))


def test_pit_counts_quantiles_at_or_below_the_outcome():
    assert_allclose(
        dg.pit(jnp.array([[1.0, 2.0, 3.0, 4.0]] * 3), jnp.array([0.0, 2.0, 9.0])), [0.0, 0.5, 1.0]
    )


def test_a_true_distribution_has_uniform_pit_and_nominal_coverage(key):
    z = jnp.asarray(scipy.stats.norm.ppf(dg.quantile_midpoints(64)), jnp.float32)
    y = jax.random.normal(key, (20_000,))
    z = jnp.broadcast_to(z, (20_000, 64))
    assert_allclose(np.histogram(dg.pit(z, y), 8, (0, 1))[0] / 20_000, 1 / 8, atol=0.02)
    assert_allclose(dg.coverage(z, y, 0.9), 0.9, atol=0.015)
    assert_allclose(
        dg.coverage(0.5 * z, y, 0.9), 2 * scipy.stats.norm.cdf(0.5 * 1.6449) - 1, atol=0.015
    )


@pytest.mark.parametrize("k", [1, 2, 4, 9])
def test_fewer_than_ten_quantiles_say_nothing_of_the_central_ninety_percent(k):
    # the outermost midpoints 1/2K and 1 − 1/2K enclose 1 − 1/K of a calibrated critic's outcomes: less than 0.9 for K < 10
    y = jnp.linspace(0, 1, 1001)
    assert jnp.isnan(dg.coverage(jnp.broadcast_to(dg.quantile_midpoints(k), (1001, k)), y, 0.9))


@pytest.mark.parametrize("of", [scipy.stats.uniform, scipy.stats.norm])
@pytest.mark.parametrize(("k", "level"), [(10, 0.9), (16, 0.9), (2, 0.5), (4, 0.75), (8, 0.5)])
def test_exact_quantiles_have_nominal_coverage_up_to_the_outermost_of_them(of, k, level):
    y = jnp.asarray(of.ppf((np.arange(10_000) + 0.5) / 10_000), jnp.float32)
    z = jnp.asarray(of.ppf(np.asarray(dg.quantile_midpoints(k))), jnp.float32)
    assert_allclose(
        dg.coverage(jnp.broadcast_to(z, (10_000, k)), y, level), level, atol=0.015
    )  # between midpoints a line


def test_crps_does_not_depend_on_the_order_of_the_quantiles():
    # sorted 0, 1, 2 with τ = 1/6, 1/2, 5/6 and outcome 1: u = 1, 0, −1, so 2/3 · (1·1/6 + 0 + 1·1/6) = 2/9
    for z in ([0.0, 1.0, 2.0], [2.0, 1.0, 0.0], [1.0, 2.0, 0.0]):
        assert_allclose(dg.crps(jnp.array(z), jnp.float32(1.0)), 2 / 9, rtol=1e-6)


def test_crps_of_a_point_is_the_distance_to_it():
    assert_allclose(dg.crps(jnp.full((2, 8), 3.0), jnp.array([5.0, 3.0])), [2.0, 0.0], atol=1e-6)


def test_crps_of_the_standard_normal_at_zero_has_its_known_value():
    # CRPS(N(0,1), 0) = 2φ(0) - 1/√π = (√2 - 1)/√π = 0.233695
    z = jnp.asarray(scipy.stats.norm.ppf(dg.quantile_midpoints(512)), jnp.float32)
    assert_allclose(dg.crps(z, jnp.float32(0.0)), 0.233695, rtol=1e-3)


@pytest.mark.parametrize("n", [1, 4, 7, 10])
def test_interquartile_mean_agrees_with_scipy(n, key):
    x = jax.random.normal(key, (n,))
    assert_allclose(dg.iqm(x), scipy.stats.trim_mean(np.asarray(x), 0.25), rtol=1e-5)


def test_bootstrap_interval_of_a_mean_agrees_with_scipy(key):
    x = jax.random.normal(key, (40,))
    got = dg.bootstrap_interval(key, x, jnp.mean, resamples=20_000)
    want = scipy.stats.bootstrap(
        (np.asarray(x),), np.mean, method="percentile", n_resamples=20_000, rng=0
    ).confidence_interval
    assert_allclose(got, want, atol=0.02)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_levels_outside_zero_and_one_are_refused(level, key):
    with pytest.raises(ValueError, match="between 0 and 1"):
        dg.bootstrap_interval(key, jnp.ones(3), level=level)
    with pytest.raises(ValueError, match="between 0 and 1"):
        dg.coverage(jnp.ones((2, 3)), jnp.ones(2), level)
