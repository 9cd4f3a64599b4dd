"""Training on MJX, as it comes, beside training on our own engine."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

import dgae_jax as dg
from dgae_jax.learn.build import make_task, make_trainer, seed_keys
from tests.parity import WARP


@cache
def returns(physics):
    """Mean return of each of ten iterations of DPPO on Hopper."""
    config = dg.Config(
        env="hopper",
        algo="dppo",
        physics=physics,
        num_envs=16,
        num_steps=128,
        total_steps=10 * 16 * 128,
    )
    trainer = make_trainer(make_task(config), 10)
    _, rows = trainer.dispatch(config, trainer.init(config, seed_keys(config)), 10)
    return np.asarray(rows["episode_return"])[:, 0]


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["native", "mjx", pytest.param("mjx-warp", marks=WARP)])
def test_ten_iterations_on_hopper_give_the_returns_of_the_jax_engine(physics):
    # the first iteration differs by the engines' rounding; from then on updates and contacts multiply it, and what remains
    # alike is how fast the policy learns (jax and native, which agree to 1e-6 per step, differ by 12 % over the last five)
    ours, theirs = returns("jax"), returns(physics)
    assert_allclose(theirs[0], ours[0], rtol=1e-3)
    assert_allclose(theirs[1], ours[1], rtol=0.05)
    assert_allclose(theirs[5:].mean(), ours[5:].mean(), rtol=0.35)
    assert theirs[-1] > 4 * theirs[0]
