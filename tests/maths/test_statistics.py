import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.maths.statistics import sample_cvar


def test_explained_variance_is_one_for_the_truth_and_zero_for_a_constant():
    y = jnp.array([1.0, 2.0, 4.0])
    assert_allclose(dg.explained_variance(y, y), 1.0)
    assert_allclose(dg.explained_variance(y + 3, y), 1.0, atol=1e-6)  # ignores an offset
    assert_allclose(dg.explained_variance(jnp.full(3, 7.0), y), 0.0, atol=1e-6)
    assert jnp.isnan(dg.explained_variance(y, jnp.ones(3)))


def test_pit_counts_quantiles_at_or_below_the_outcome():
    quantiles = jnp.array([[1.0, 2.0, 3.0, 4.0]] * 3)
    assert_allclose(dg.pit(quantiles, jnp.array([0.0, 2.0, 9.0])), [0.0, 0.5, 1.0])


def test_true_distribution_has_uniform_pit(key):
    z = jnp.asarray(scipy.stats.norm.ppf(dg.quantile_midpoints(64)), jnp.float32)
    pit = dg.pit(jnp.broadcast_to(z, (20_000, 64)), jax.random.normal(key, (20_000,)))
    assert_allclose(np.histogram(pit, 8, (0, 1))[0] / 20_000, 1 / 8, atol=0.02)


@pytest.mark.parametrize("of", [scipy.stats.uniform, scipy.stats.norm])
@pytest.mark.parametrize(("k", "level"), [(10, 0.9), (4, 0.75), (9, 0.9)])
def test_exact_quantiles_have_nominal_coverage_up_to_the_outermost(of, k, level):
    # the outermost midpoints enclose 1 − 1/K of the outcomes: less than 0.9 for K < 10
    y = jnp.asarray(of.ppf((np.arange(10_000) + 0.5) / 10_000), jnp.float32)
    z = jnp.asarray(of.ppf(np.asarray(dg.quantile_midpoints(k))), jnp.float32)
    want = level if level <= 1 - 1 / k else np.nan
    assert_allclose(dg.coverage(jnp.broadcast_to(z, (10_000, k)), y, level), want, atol=0.015)


def test_crps_does_not_depend_on_the_order_of_the_quantiles():
    # sorted 0, 1, 2 with τ = 1/6, 1/2, 5/6 and outcome 1: 2/3 · (1·1/6 + 0 + 1·1/6) = 2/9
    for z in ([0.0, 1.0, 2.0], [2.0, 1.0, 0.0], [1.0, 2.0, 0.0]):
        assert_allclose(dg.crps(jnp.array(z), jnp.float32(1.0)), 2 / 9, rtol=1e-6)


def test_crps_of_the_standard_normal_at_zero_has_its_known_value():
    # 2φ(0) − 1/√π = (√2 − 1)/√π = 0.233695
    z = jnp.asarray(scipy.stats.norm.ppf(dg.quantile_midpoints(512)), jnp.float32)
    assert_allclose(dg.crps(z, jnp.float32(0.0)), 0.233695, rtol=1e-3)


# two of eight off at each end: (3 + 4 + 5 + 6) / 4; ⌊3/4⌋ = 0
@pytest.mark.parametrize(("scores", "mean"), [([8, 1, 7, 2, 6, 3, 5, 4], 4.5), ([1, 2, 6], 3.0)])
def test_interquartile_mean_leaves_out_a_quarter_at_each_end(scores, mean):
    assert dg.iqm(np.array(scores, float)) == mean
    assert dg.iqm(jnp.array(scores, float)) == mean
    assert dg.iqm([np.array(scores[:1], float), np.array(scores[1:], float)]) == mean  # pooled


def test_interval_of_two_samples_lies_between_them():
    # a quarter of the draws is twice the lower sample, a quarter twice the higher one
    assert_array_equal(dg.bootstrap_interval(np.array([1.0, 3.0])), [1, 3])


def _pooled(*tasks, axis):
    return scipy.stats.trim_mean(np.concatenate(tasks, axis), 0.25, axis=axis)


@pytest.mark.parametrize("level", [0.95, 0.5])
def test_stratified_interval_agrees_with_scipy(level):
    """The ends are sure to about 2 % of the width; four such errors are allowed."""
    tasks = list(np.random.default_rng(5).normal(1.0, 0.3, (3, 10)))
    how = {"method": "percentile", "batch": 500, "confidence_level": level}
    rng = np.random.default_rng(7)
    known = scipy.stats.bootstrap(tasks, _pooled, n_resamples=5000, rng=rng, **how)
    low, high = known.confidence_interval
    got = dg.bootstrap_interval(tasks, level=level)
    assert_allclose(got, [low, high], atol=0.08 * (high - low))


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_levels_outside_zero_and_one_are_refused(level):
    with pytest.raises(ValueError, match="between 0 and 1"):
        dg.bootstrap_interval(np.ones(3), level=level)
    with pytest.raises(ValueError, match="between 0 and 1"):
        dg.coverage(jnp.ones((2, 3)), jnp.ones(2), level)


def test_cvar_of_samples_is_the_mean_of_the_lowest_one_at_least():
    assert sample_cvar(np.array([4.0, 1, 3, 2]), 0.5) == 1.5
    assert sample_cvar(np.array([4.0, 1, 3, 2]), 0.05) == 1
