"""Every algorithm learns: returns after a short training are far above those of a policy that does not."""

import dataclasses

import pytest

from dgae_jax.configs.presets import preset
from dgae_jax.run.api import train
from tests.runs import QUIET

FLOORS = {"ppo": 330, "dppo": 1200, "trpo": 1000, "dtrpo": 1000, "a2c": 700, "da2c": 900}
"""Return on Hopper, about half of the lower of two seeds when this was written or less: 673, 2,457, 2,793, 2,493, 1,495 and 1,981. Random
actions get 18."""


@pytest.mark.slow
@pytest.mark.parametrize("algo", FLOORS)
def test_150_000_samples_of_hopper_teach_an_algorithm_to_hop(algo):
    config = dataclasses.replace(
        preset("tuned", algo, "hopper"), physics="native", total_steps=150_000, num_seeds=2
    )
    evaluation = train(config, quiet=True, episodes=20, cache_dir=QUIET.cache_dir).evaluation
    assert [seed["return_mean"] > FLOORS[algo] for seed in evaluation["seeds"]] == [True, True], (
        evaluation
    )
