import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from numpy.testing import assert_allclose

from dgae_jax.maths import gaussian
from dgae_jax.maths.gaussian import Gaussian


def pair(key):
    p_mean, q_mean, p_log, q_log = jax.random.normal(key, (4, 5, 3))
    return Gaussian(p_mean, 0.3 * p_log), Gaussian(q_mean, 0.3 * q_log)


def test_log_prob_and_entropy_agree_with_scipy(key):
    p, q = pair(key)
    for i in range(5):
        mean, variance, x = (np.asarray(x[i]) for x in (p.mean, jnp.exp(2 * p.log_std), q.mean))
        want = scipy.stats.multivariate_normal(mean, np.diag(variance))
        assert_allclose(gaussian.log_prob(p, q.mean)[i], want.logpdf(x), rtol=1e-4)
        assert_allclose(gaussian.entropy(p)[i], want.entropy(), rtol=1e-5)


def test_kl_by_hand_and_of_a_distribution_with_itself(key):
    # log(2/1) + (1 + (1 - 0)²) / (2·4) - ½ = 0.693147 + 0.25 - 0.5
    one, zero = jnp.ones(1), jnp.zeros(1)
    wide = Gaussian(zero, jnp.log(2 * one))
    assert_allclose(gaussian.kl(Gaussian(one, zero), wide), 0.443147, rtol=1e-5)
    p, _ = pair(key)
    assert_allclose(gaussian.kl(p, p), 0.0, atol=0)


def test_kl_is_the_mean_log_ratio_of_samples(key):
    p, q = (Gaussian(x.mean[0], x.log_std[0]) for x in pair(key))
    many = Gaussian(*(jnp.broadcast_to(x, (200_000, 3)) for x in p))
    x = gaussian.sample(key, many)
    ratio = gaussian.log_prob(p, x) - gaussian.log_prob(q, x)
    assert abs(ratio.mean() - gaussian.kl(p, q)) < 5 * ratio.std() / 200_000**0.5
