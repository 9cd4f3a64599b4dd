"""Every algorithm learns: a short training raises the return far above that of random actions."""

import json

import pytest

from tests import studies
from tests.helpers import CACHE

FLOORS = {"ppo": 330, "dppo": 1200, "trpo": 1000, "dtrpo": 1000, "a2c": 700, "da2c": 900}
"""About half of the lower return of two seeds on Hopper, or less. Random actions get 18.

A process of its own has the devices of a user's run: another number of them rounds differently, and
with one device a seed of TRPO learns later.
"""


@pytest.mark.slow
@pytest.mark.parametrize("algo", FLOORS)
def test_an_algorithm_learns_to_hop_from_150_000_samples(algo, tmp_path):
    task = ["--env", "hopper", "--physics", "native", "--total-steps", "150000", "--num-seeds", "2"]
    place = ["--run-dir", tmp_path / "run", "--cache-dir", CACHE]
    studies.succeed(studies.command("experiments/train.py", "--algo", algo, *task, *place))
    evaluation = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert [seed["return_mean"] > FLOORS[algo] for seed in evaluation["seeds"]] == [True, True], (
        evaluation
    )
