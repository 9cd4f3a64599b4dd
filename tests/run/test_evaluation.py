"""Episodes of trained policies."""

import dataclasses

import numpy as np
import pytest

import dgae_jax as dg
from dgae_jax.configs.build import make_trainer, policies_of, seed_keys
from dgae_jax.configs.config import ConfigError
from dgae_jax.run.evaluation import evaluate_policies
from tests.helpers import SMALL


def test_an_environment_of_braxs_own_is_evaluated_in_its_own_physics_only(state):
    with pytest.raises(ConfigError, match=r"engine gymnasium: must be one of mjx with brax:ant"):
        evaluate_policies(policies_of(state), dataclasses.replace(SMALL, env="brax:ant"), engine="gymnasium", episodes=1)


@pytest.mark.parametrize("engine", ["gymnasium", "native"])
def test_an_untrained_policy_falls_at_once_in_every_engine_and_each_seed_is_reported(engine):
    config = dataclasses.replace(SMALL, num_seeds=2, seed=3)
    state = make_trainer(dg.make_env("hopper", physics="native"), 1).init(config, seed_keys(config))
    result = evaluate_policies(policies_of(state), config, engine=engine, episodes=5)
    assert result["episodes"] == len(result["returns"]) == 10
    assert [s["seed"] for s in result["seeds"]] == [3, 4]
    assert result["returns"] == result["seeds"][0]["returns"] + result["seeds"][1]["returns"]
    assert result["return_mean"] == pytest.approx(np.mean(result["returns"]), rel=1e-4)
    assert result["return_std"] == pytest.approx(np.std(result["returns"]), rel=1e-3)
    assert 0 < result["return_mean"] < 300


def test_native_and_gymnasium_give_the_same_policy_the_same_return():
    config = dataclasses.replace(SMALL, seed=1)
    state = make_trainer(dg.make_env("hopper", physics="native"), 1).init(config, seed_keys(config))
    ours, theirs = (evaluate_policies(policies_of(state), config, engine=engine, episodes=40) for engine in ("native", "gymnasium"))
    error = (ours["return_std"] ** 2 + theirs["return_std"] ** 2) ** 0.5 / 40**0.5
    assert abs(ours["return_mean"] - theirs["return_mean"]) < 4 * error
