"""Every algorithm learns: returns after a short training are far above those of a policy that does not."""

import dataclasses

import pytest

from dgae_jax.configs.presets import preset
from dgae_jax.run.api import train
from tests.runs import QUIET

FLOORS = {"ppo": 0, "dppo": 0, "trpo": 0, "dtrpo": 0, "a2c": 0, "da2c": 0}
"""Return on Hopper: about half of what was measured (docs/results.md); a policy that stands still gets about 200."""


@pytest.mark.slow
@pytest.mark.parametrize("algo", FLOORS)
def test_150_000_samples_of_hopper_teach_an_algorithm_to_hop(algo):
    config = dataclasses.replace(preset("tuned", algo, "hopper"), physics="native", total_steps=150_000, num_seeds=2)
    evaluation = train(config, quiet=True, episodes=20, cache_dir=QUIET.cache_dir).evaluation
    assert [seed["return_mean"] > FLOORS[algo] for seed in evaluation["seeds"]] == [True, True], evaluation
