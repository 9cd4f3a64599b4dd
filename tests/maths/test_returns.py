import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

import dgae_jax as dg
from dgae_jax.maths.returns import decay

GAMMA, LAM = 0.9, 0.8
CVAR_HALF = jnp.array([2.0, 2.0, 0.0, 0.0])
WEIGHTS = [None, CVAR_HALF]


def trajectory(key, steps=12, envs=3, k=4, ends=True):
    keys = jax.random.split(key, 5)
    terminated = jax.random.bernoulli(keys[0], 0.2 * ends, (steps, envs))
    truncated = jax.random.bernoulli(keys[1], 0.2 * ends, (steps, envs)) & ~terminated
    reward = jax.random.normal(keys[2], (steps, envs))
    z = jax.random.normal(keys[3], (steps + 1, envs, k))
    # the successor of an episode's last step is not the next row
    elsewhere = jax.random.normal(keys[4], (steps, envs, k))
    z_next = jnp.where((terminated | truncated)[..., None], elsewhere, z[1:])
    return reward, z[:-1], z_next, terminated, truncated


def test_gae_of_three_steps_by_hand():
    # γ = λ = ½; δ = 1 + ½·1 - ½ = 1, 2 + ½·1.5 - 1 = 1.75, last: 3 - 1.5 = 1.5 where it terminates
    # A₂ = 1.5, A₁ = 1.75 + ¼·1.5 = 2.125, A₀ = 1 + ¼·2.125 = 1.53125
    steps = jnp.array([[1.0, 2.0, 3.0], [0.5, 1.0, 1.5], [1.0, 1.5, 2.0]])
    no, middle, last = jnp.array([[0, 0, 0], [0, 1, 0], [0, 0, 1]], bool)

    def gae(terminated, truncated):
        return dg.gae(*steps, terminated, truncated, gamma=0.5, lam=0.5)

    assert_allclose(gae(last, no), [1.53125, 2.125, 1.5])
    # truncated instead: the last step bootstraps, δ₂ = 3 + ½·2 - 1.5 = 2.5
    assert_allclose(gae(no, last), [1.59375, 2.375, 2.5])
    # truncated in the middle: δ₁ keeps its bootstrap and the trace stops there
    assert_allclose(gae(no, middle), [1.4375, 1.75, 2.5])
    # terminated in the middle: δ₁ = 2 - 1 = 1
    assert_allclose(gae(middle, no), [1.25, 1.0, 2.5])


def test_dgae_with_the_identity_metric_is_gae_on_the_means(key):
    reward, z, z_next, terminated, truncated = trajectory(key)
    got = dg.dgae(reward, z, z_next, terminated, 1.0 * truncated, gamma=GAMMA, lam=LAM)
    want = dg.gae(reward, z.mean(-1), z_next.mean(-1), terminated, truncated, gamma=GAMMA, lam=LAM)
    assert_allclose(got, want, atol=1e-5)


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("n", [1, 5])
def test_n_step_advantages_telescope_into_td_errors(n, weights, key):
    reward, z, z_next, terminated, truncated = trajectory(key, ends=False)
    args = reward, z, z_next, terminated, truncated
    got = dg.n_step_advantage(*args, gamma=GAMMA, n=n, weights=weights)
    delta = dg.distributional_td_residual(reward, jnp.full_like(reward, GAMMA), z, z_next, weights)
    for t in range(12):
        want = sum(GAMMA**k * delta[t + k] for k in range(min(n, 12 - t)))
        assert_allclose(got[t], want, atol=1e-5)


@pytest.mark.parametrize("lam", [0.0, LAM, 1.0])
@pytest.mark.parametrize("weights", WEIGHTS)
def test_dgae_is_the_exponential_average_of_n_step_advantages(weights, lam, key):
    # (1-λ) Σ λⁿ⁻¹ Â⁽ⁿ⁾; beyond the trajectory's end all are the last one, which takes the rest
    args = trajectory(key)
    steps = [dg.n_step_advantage(*args, gamma=GAMMA, n=n, weights=weights) for n in range(1, 13)]
    average = sum((1 - lam) * lam**i * a for i, a in enumerate(steps[:-1])) + lam**11 * steps[-1]
    assert_allclose(dg.dgae(*args, gamma=GAMMA, lam=lam, weights=weights), average, atol=1e-5)


def test_an_n_step_advantage_of_no_steps_is_refused(key):
    with pytest.raises(ValueError, match="at least 1"):
        dg.n_step_advantage(*trajectory(key), gamma=GAMMA, n=0)


# ---- critic targets ----


def test_lambda_shift_has_the_lambda_mean_and_one_step_shape(key):
    reward, z, z_next, *ends = trajectory(key)
    d = decay(*ends, gamma=GAMMA, lam=LAM)
    mean = z.mean(-1) + dg.gae(reward, z.mean(-1), z_next.mean(-1), *ends, gamma=GAMMA, lam=LAM)
    assert_allclose(dg.lambda_return(reward, *d, z, z_next), mean, atol=1e-6)
    got = dg.lambda_shift_target(reward, *d, z, z_next)
    one_step = dg.bellman_target(reward, d[0], z_next)
    assert_allclose(got.mean(-1), mean, atol=1e-5)
    shapes = (x - x.mean(-1, keepdims=True) for x in (got, one_step))
    assert_allclose(*shapes, atol=1e-5)


@pytest.mark.parametrize("lam", [0.0, 1.0])
def test_sr_lambda_zero_is_one_step_and_one_the_end_of_the_trace(lam, key):
    reward, _, z_next, *ends = trajectory(key)
    discount, trace = decay(*ends, gamma=GAMMA, lam=lam)
    got, later = dg.sr_lambda_target(key, reward, discount, trace, z_next), z_next[-1]
    for t in reversed(range(12)):
        later = jnp.where(trace[t][:, None] > 0, later, z_next[t])
        later = dg.bellman_target(reward[t], discount[t], later)
        assert_allclose(got[t], later, atol=1e-5)


def test_sr_lambda_has_the_mean_of_the_lambda_return(key):
    reward, z, z_next, *ends = trajectory(key)
    d = decay(*ends, gamma=GAMMA, lam=LAM)
    keys = jax.random.split(key, 4_000)
    draws = jax.vmap(lambda k: dg.sr_lambda_target(k, reward, *d, z_next).mean(-1))(keys)
    error = draws.mean(0) - dg.lambda_return(reward, *d, z, z_next)
    assert jnp.all(jnp.abs(error) < 5 * draws.std(0) / 4_000**0.5 + 1e-5)
