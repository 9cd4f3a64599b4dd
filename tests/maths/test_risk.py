import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import norm

from dgae_jax.maths.returns import distributional_td_residual
from dgae_jax.maths.risk import METRICS, weights_of


def test_cvar_of_a_quarter_weighs_the_lowest_quarter_by_four():
    assert_allclose(weights_of("cvar:0.25", 8), [4, 4, 0, 0, 0, 0, 0, 0], atol=1e-6)
    # α cuts the second weight in proportion
    assert_allclose(weights_of("cvar:0.3", 4), [1 / 0.3, 4 * 0.05 / 0.3, 0, 0], rtol=1e-5)


def test_power_two_is_the_expected_minimum_of_two_draws():
    values = jnp.array([1.0, 2.0, 4.0, 8.0])
    draws = np.minimum.outer(np.asarray(values), np.asarray(values)).mean()
    assert_allclose((weights_of("power:2", 4) * values).mean(), draws, rtol=1e-6)


def test_wang_shifts_the_mean_of_a_normal_by_its_parameter():
    quantiles = norm.ppf((2 * np.arange(4000) + 1) / 8000)
    assert_allclose((weights_of("wang:0.5", 4000) * quantiles).mean(), -0.5, atol=0.01)


def test_neutral_parameters_are_the_mean_and_the_mean_needs_no_weights():
    for spec in ("cvar:1", "wang:0", "power:1", "mean-cvar:0.1:0"):
        assert_allclose(weights_of(spec, 16), jnp.ones(16), rtol=1e-4)
    assert weights_of("mean", 16) is None


@pytest.mark.parametrize(
    ("spec", "allowed"),
    [
        ("cvar", "one of mean, cvar:α"),
        ("median", "one of mean, cvar:α"),
        ("mean:1", "one of mean, cvar:α"),
        ("cvar:x", "cvar:α with numbers"),
        ("cvar:0", "cvar:α with 1e-6 ≤ α ≤ 1"),
        ("wang:inf", "wang:β with −5 ≤ β ≤ 5"),
        ("mean-cvar:0.1:2", "mean-cvar:α:weight with"),
    ],
)
def test_other_metrics_are_refused_with_what_is_allowed(spec, allowed):
    with pytest.raises(ValueError, match=f"^{allowed}"):
        weights_of(spec, 8)


def test_custom_metrics_join_the_table_and_must_have_mean_one(monkeypatch):
    neutral = METRICS["mean"]
    median = neutral._replace(weights=lambda k: jnp.zeros(k).at[k // 2].set(k))
    monkeypatch.setitem(METRICS, "median", median)
    monkeypatch.setitem(METRICS, "double", neutral._replace(weights=lambda k: 2 * jnp.ones(k)))
    assert_allclose(weights_of("median", 3), [0, 3, 0])
    with pytest.raises(ValueError, match="mean 1"):
        weights_of("double", 3)


def test_risk_cancels_at_lambda_one_and_counts_once_at_lambda_zero():
    # a coin pays 0 or 10: a perfect critic knows {0, 10} before and the payment after
    weights, before = weights_of("cvar:0.5", 2), jnp.array([0.0, 10.0])

    def delta(reward, quantiles, next_quantiles):
        one = jnp.float32(1)
        return distributional_td_residual(reward, one, quantiles, next_quantiles, weights)

    coin = jnp.stack([delta(jnp.float32(r), before, jnp.zeros(2)) for r in (0, 10)])
    # the value by CVaR is 0: E[δ] ≠ 0 although the critic is perfect
    assert_allclose(coin, [0, 10])
    # λ = 1: the gamble and a sure 5 from the same state differ by their means alone
    assert_allclose(coin.mean() - delta(jnp.float32(5), before, jnp.zeros(2)), 0, atol=1e-6)
    # λ = 0: the step into the gamble is 5 worse than the step to the sure payment
    enter = [delta(jnp.float32(0), before, z) for z in (before, jnp.array([5.0, 5.0]))]
    assert_allclose(enter[0] - enter[1], -5)
