import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import dgae_jax as dg
from dgae_jax.maths.transport import monotone_quantiles

CVAR_HALF = jnp.array([2.0, 2.0, 0.0, 0.0])  # mean of the worse half


def test_midpoints_of_four_quantiles_are_the_odd_eighths():
    assert_allclose(dg.quantile_midpoints(4), [1 / 8, 3 / 8, 5 / 8, 7 / 8])
    with pytest.raises(ValueError, match="at least 1"):
        dg.quantile_midpoints(0)


def test_directional_metric_by_hand():
    # ((3 - 0) + (5 - 1) + (1 - 2)) / 3 = 6 / 3
    metric = dg.directional_metric
    assert_allclose(metric(jnp.array([3.0, 5.0, 1.0]), jnp.array([0.0, 1.0, 2.0])), 2.0)
    # sorted u = 1 2 3 4, sorted v = 0 0 1 1: (2·(1-0) + 2·(2-0)) / 4 = 1.5
    u, v = jnp.array([4.0, 1.0, 3.0, 2.0]), jnp.array([0.0, 1.0, 0.0, 1.0])
    assert_allclose(metric(u, v, CVAR_HALF), 1.5)
    assert_allclose(jax.jit(metric)(u, v, CVAR_HALF), 1.5)  # traced weights


@pytest.mark.parametrize("weights", [None, CVAR_HALF])
def test_metric_is_antisymmetric_and_equivariant(weights, key):
    u, v = jax.random.normal(key, (2, 7, 3, 4))
    d = dg.directional_metric(u, v, weights)
    assert d.shape == (7, 3)
    assert_allclose(dg.directional_metric(v, u, weights), -d, atol=1e-6)
    assert_allclose(dg.directional_metric(u + 5, v, weights), d + 5, atol=1e-5)
    assert_allclose(dg.directional_metric(3 * u, 3 * v, weights), 3 * d, atol=1e-5)


def test_metric_is_signed_wasserstein_under_dominance(key):
    u = jax.random.normal(key, (5, 16))
    v = u + jnp.arange(1.0, 17.0)
    assert_allclose(dg.directional_metric(v, u), dg.wasserstein(v, u), rtol=1e-5)
    assert_allclose(dg.directional_metric(u, v), -dg.wasserstein(v, u), rtol=1e-5)


def test_equal_means_are_near_in_the_metric_and_far_in_wasserstein():
    narrow, wide = jnp.array([-1.0, 1.0]), jnp.array([-10.0, 10.0])
    assert_allclose(dg.directional_metric(wide, narrow), 0.0)
    assert_allclose(dg.wasserstein(wide, narrow), 9.0)


@pytest.mark.parametrize("weights", [[1.0, 2.0], [3.0, -1.0], [[1.0, 1.0]], [float("nan"), 1.0]])
def test_weights_that_are_negative_or_not_of_mean_one_are_refused(weights):
    with pytest.raises(ValueError, match="of mean 1"):
        dg.directional_metric(jnp.zeros(2), jnp.zeros(2), jnp.array(weights))


@pytest.mark.parametrize("p", [1.0, 2.0])
def test_wasserstein_agrees_with_scipy(p, key):
    u, v = np.asarray(jax.random.normal(key, (2, 11)))
    second = np.mean((np.sort(u) - np.sort(v)) ** 2) ** 0.5
    want = scipy.stats.wasserstein_distance(u, v) if p == 1 else second
    assert_allclose(dg.wasserstein(jnp.asarray(u), jnp.asarray(v), p), want, rtol=1e-5)


def test_monotone_quantiles_by_hand():
    # gaps log(1 + e^0) = log 2 and log(1 + e^log 3) = log 4 about the mean 1
    first = 1 - 4 * np.log(2) / 3
    want = [first, first + np.log(2), first + 3 * np.log(2)]
    assert_allclose(monotone_quantiles(jnp.array([1.0, 5.0, 5.0 + np.log(3)])), want, rtol=1e-6)


@pytest.mark.parametrize("k", [1, 64])
def test_monotone_quantiles_do_not_cross_and_have_the_given_mean(k, key):
    outputs = 10 * jax.random.normal(key, (100, k))
    z = monotone_quantiles(outputs)
    assert z.shape == (100, k)
    assert float(jnp.diff(z).min(initial=1)) > -1e-5
    assert_allclose(z.mean(-1), outputs[:, 0], atol=1e-4)


@pytest.mark.parametrize(
    ("k", "j", "device"), [(1, 1, "cpu"), (3, 40, "cpu"), (17, 16, "cpu"), (5, 6, "elsewhere")]
)
def test_quantile_huber_loss_and_its_gradients_match_numpy(k, j, device, key, request):
    if device == "elsewhere":
        request.getfixturevalue("elsewhere")
    z, y = 3 * jax.random.normal(key, (5, k)), 3 * jax.random.normal(jax.random.key(1), (2, 5, j))

    def laid_out(z, y, kappa):
        u = np.asarray(y)[..., None, :] - np.asarray(z)[..., :, None]
        tau = ((np.arange(k) + 0.5) / k)[:, None]
        weight = np.abs(tau - (u < 0))
        loss = weight * np.where(np.abs(u) <= kappa, 0.5 * u**2, kappa * (np.abs(u) - 0.5 * kappa))
        slope = weight * np.clip(u, -kappa, kappa)
        return loss.mean(-1).sum(-1), -slope.mean(-1).sum(0), slope.sum(-2) / j

    loss = jax.jit(lambda z, y: dg.quantile_huber_loss(z, y, kappa=0.7))
    value, *slopes = laid_out(z, y, 0.7)
    assert_allclose(loss(z, y), value, rtol=1e-5)
    gradients = jax.grad(lambda z, y: loss(z, y).sum(), argnums=(0, 1))(z, y)
    for got, want in zip(gradients, slopes, strict=True):
        assert_allclose(got, want, rtol=1e-5, atol=1e-6)


def test_quantile_huber_loss_is_minimal_at_empirical_quantiles(key):
    # 101·τᵢ is no whole number for K = 4, so that the empirical quantile is one of the samples
    samples = jax.random.normal(key, (101,))
    guesses = jnp.broadcast_to(samples[:, None], (101, 4))
    by_quantile = jax.vmap(jax.vmap(lambda z: dg.quantile_huber_loss(z, samples, kappa=1e-3)))
    losses = by_quantile(guesses[..., None] * jnp.eye(4))
    taus = np.asarray(dg.quantile_midpoints(4))
    want = np.quantile(np.asarray(samples), taus, method="inverted_cdf")
    assert_allclose(samples[losses.argmin(0)], want)
