"""Every algorithm learns: a short training raises the return far above that of random actions."""

import dataclasses

import pytest

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.presets import preset
from dgae_jax.run.api import train
from tests.runs import QUIET

FLOOR = 300
"""Each of two seeds on Hopper returns more than twice as much; random actions get 18."""


@pytest.mark.slow
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_an_algorithm_learns_to_hop_from_150_000_samples(algo):
    config = dataclasses.replace(
        preset("tuned", algo, "hopper"), physics="native", total_steps=150_000, num_seeds=2
    )
    evaluation = train(config, quiet=True, episodes=20, cache_dir=QUIET.cache_dir).evaluation
    assert min(seed["return_mean"] for seed in evaluation["seeds"]) > FLOOR
