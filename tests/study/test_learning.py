"""Every algorithm learns: a short training raises the return far above that of random actions."""

import dataclasses

import pytest

from dgae_jax.configs.presets import preset
from dgae_jax.run.api import train
from tests.runs import QUIET

FLOORS = {"ppo": 330, "dppo": 1200, "trpo": 1000, "dtrpo": 1000, "a2c": 700, "da2c": 900}
"""About half of the lower return of two seeds on Hopper, or less. Random actions get 18."""


@pytest.mark.slow
@pytest.mark.parametrize("algo", FLOORS)
def test_an_algorithm_learns_to_hop_from_150_000_samples(algo):
    config = dataclasses.replace(
        preset("tuned", algo, "hopper"), physics="native", total_steps=150_000, num_seeds=2
    )
    evaluation = train(config, quiet=True, episodes=20, cache_dir=QUIET.cache_dir).evaluation
    assert [seed["return_mean"] > FLOORS[algo] for seed in evaluation["seeds"]] == [True, True], (
        evaluation
    )
