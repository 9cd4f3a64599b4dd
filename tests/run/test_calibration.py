"""Critics against Monte Carlo returns, and critics that are fitted to them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.learn.networks import Value
from dgae_jax.maths.transport import quantile_midpoints
from dgae_jax.run import calibration, checkpoint, directory, episodes, training
from tests.runs import QUIET, small

UNIFORM = jnp.tile(quantile_midpoints(100), (1000, 1, 1))
RETURNS = ((jnp.arange(1000) + 0.5) / 1000)[:, None]
"""Quantiles of a uniform distribution on 0 … 1, and returns that have it."""
SLOPES = np.array([[1.0], [3.0]])


def test_true_distribution_is_calibrated():
    found = calibration.calibration_statistics(UNIFORM, RETURNS)
    assert found["coverage_90"] == pytest.approx(0.9, abs=0.002)
    assert found["pit"] == pytest.approx([1 / calibration.BINS] * calibration.BINS, abs=0.011)
    assert sum(found["pit"]) == pytest.approx(1)
    # the mean is 1/2 and a uniform variable has standard deviation 1/√12
    assert (found["crossing"], found["bias"]) == pytest.approx((0, 0), abs=1e-6)
    assert (found["rmse"], found["spread"]) == pytest.approx((12**-0.5, 12**-0.5), abs=1e-4)


def test_half_as_wide_distribution_covers_half():
    found = calibration.calibration_statistics(0.25 + UNIFORM / 2, RETURNS)
    assert found["coverage_90"] == pytest.approx(0.45, abs=0.002)
    assert found["pit"][0] + found["pit"][-1] == pytest.approx(0.55, abs=0.02)
    assert calibration.calibration_statistics(UNIFORM[..., ::-1], RETURNS)["crossing"] == 1


def test_similar_means_differ_in_shape_alone():
    reward, discount = jnp.zeros((4, 1)), jnp.ones((4, 1))
    # twice as wide (d = 0, W₁ = 1), moved by 1 (d = W₁ = 1), moved by −1 and by 0.95:
    # d = (−1 + 0.95) / 2 = −0.025 and W₁ = 0.975 in the last step, a share of 0.0256
    quantiles = jnp.array([[-1.0, 1.0], [-2.0, 2.0], [-1.0, 3.0], [-2.0, 3.95]])[:, None]
    expected = {"0.1": 2 / 3, "0.03": 2 / 3, "0.01": 1 / 3, "0.003": 1 / 3}
    found = calibration.similar_mean_shares(reward, discount, quantiles)
    assert found == pytest.approx(expected, abs=1e-6)


def test_returns_without_end_are_refused():
    with pytest.raises(ConfigError, match=r"gamma 0\.99999: must be at most 0\.9999"):
        calibration.return_steps(dataclasses.replace(small("dppo"), gamma=0.99999))
    pendulum = {"env": "gymnasium:Pendulum-v1", "env_version": None, "physics": "gymnasium"}
    with pytest.raises(ConfigError, match=r"env gymnasium:Pendulum-v1: must be a task without"):
        calibration.return_steps(dataclasses.replace(small("ppo"), **pendulum))


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        # F⁻¹(τ) = l + cτ of a uniform variable on l … l + c; c is 1 in one state, 3 in the other
        (lambda obs, u: u * (2 + obs), SLOPES * quantile_midpoints(16)),
        (lambda obs, u: u * (2 + obs) - 1500, SLOPES * quantile_midpoints(16) - 1500),
        # one state pays 1, the other 0 with probability ¼: F⁻¹ is 0 up to ¼ and 1 beyond
        (lambda obs, u: 1.0 - ((obs > 0) & (u < 0.25)), [[1.0] * 16, [0.0] * 4 + [1.0] * 12]),
    ],
)
def test_fit_finds_quantiles(returns, expected):
    which, luck = (jax.random.uniform(jax.random.key(i), (20_000,)) for i in range(2))
    obs = jnp.where(which < 0.5, -1.0, 1.0)
    samples = obs[:, None], returns(obs, luck)
    params = calibration.fit_quantiles(samples, 16, (32,), 200, jax.random.key(2))
    found = Value((32,), 16).apply(params, jnp.array([[-1.0], [1.0]]))
    np.testing.assert_allclose(found, expected, atol=0.15)


@pytest.mark.slow  # programs of their own are compiled
@pytest.mark.parametrize("algo", ["ppo", "dppo"])
def test_refit_keeps_the_policy_and_is_calibrated(algo, tmp_path):
    run_dir, file = tmp_path / "run", tmp_path / "refit.msgpack"
    training.train(small(algo, seeds=2), dataclasses.replace(QUIET, run_dir=run_dir))
    config = directory.read_config(run_dir)

    def write():
        made = calibration.refit(run_dir, config, which="latest", index=1, num_envs=16)
        checkpoint.save_networks(file, *made)

    write()
    before = file.read_bytes()
    write()
    assert file.read_bytes() == before
    whole, alone = dg.load_policy(run_dir, seed=1), dg.load_policy(file)
    obs = np.random.default_rng(0).normal(size=(100, 11))
    np.testing.assert_array_equal(alone(obs), whole(obs))
    assert (np.diff(alone.quantiles(obs)) >= 0).all()
    after = directory.config_of(file)
    assert (after.seed, after.num_seeds, after.critic.kind) == (config.seed + 1, 1, "sorted")
    assert checkpoint.reward_std(file, after) > 0
    found = calibration.calibrate(file, after, which="latest")
    assert found["samples"] == calibration.NUM_ENVS * episodes.SAMPLED_CHUNK
    assert found["crossing"] == 0
    assert np.isfinite([*found["pit"], found["rmse"], *found["similar_means"].values()]).all()
