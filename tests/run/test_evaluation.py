"""Episodes of trained policies."""

import dataclasses

import numpy as np
import pytest

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.learn.build import make_task, make_trainer, policies_of, seed_keys
from dgae_jax.run.evaluation import (
    default_path,
    describe,
    episode_seeds,
    evaluate_policies,
    seed_statistics,
    summary,
)
from dgae_jax.run.metrics import EvaluationsFile
from dgae_jax.run.options import engines_of
from tests.runs import SMALL


def test_an_environment_of_braxs_own_is_evaluated_in_its_own_physics_only(state):
    with pytest.raises(ConfigError, match=r"engine gymnasium: must be one of mjx with brax:ant"):
        evaluate_policies(
            policies_of(state),
            dataclasses.replace(SMALL, env="brax:ant"),
            engine="gymnasium",
            episodes=1,
        )


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
    ours, theirs = (
        evaluate_policies(policies_of(state), config, engine=engine, episodes=40)
        for engine in ("native", "gymnasium")
    )
    error = (ours["return_std"] ** 2 + theirs["return_std"] ** 2) ** 0.5 / 40**0.5
    assert abs(ours["return_mean"] - theirs["return_mean"]) < 4 * error


def test_every_run_has_a_first_engine_and_files_of_their_own_for_each_engine_and_checkpoint(
    tmp_path,
):
    assert engines_of(SMALL)[0] == "gymnasium"
    assert {"native", "jax"} <= set(engines_of(SMALL))
    assert engines_of(dataclasses.replace(SMALL, env="brax:ant", physics="mjx")) == ("mjx",)
    names = [
        default_path(tmp_path, engine, which).name
        for engine in ("native", "jax")
        for which in ("latest", "best")
    ]
    assert names == [
        "evaluation-native.json",
        "evaluation-native-best.json",
        "evaluation-jax.json",
        "evaluation-jax-best.json",
    ]


def test_no_two_seeds_have_an_initial_state_in_common():
    numbers = np.concatenate([episode_seeds(seed, 50) for seed in range(20)])
    assert len(set(numbers.tolist())) == 1000
    np.testing.assert_array_equal(episode_seeds(3, 20), episode_seeds(3, 50)[:20])


@pytest.mark.parametrize("engine", ["gymnasium", "native"])
def test_another_seed_plays_other_episodes_and_the_same_seed_the_same(engine, state):
    def returns(seed, episodes=6):
        return evaluate_policies(
            policies_of(state), SMALL, engine=engine, episodes=episodes, seed=seed
        )["returns"]

    assert returns(0) == returns(0)
    assert not set(returns(0)) & set(returns(1))
    np.testing.assert_allclose(returns(0, 3), returns(0)[:3], rtol=1e-3)


def test_an_evaluation_says_where_it_is_and_can_be_broken_off_between_chunks(state):
    said = []

    def watch(text):
        said.append(text)
        if "step 50" in text:
            raise KeyboardInterrupt

    config = dataclasses.replace(SMALL, env="swimmer")  # which never falls
    swimmer = make_trainer(make_task(config), 1).init(config, seed_keys(config))
    for engine in ("gymnasium", "native"):
        with pytest.raises(KeyboardInterrupt):
            evaluate_policies(policies_of(swimmer), config, engine=engine, episodes=2, watch=watch)
        assert said[-2:] == [
            f"evaluating 2 episodes in Swimmer-v4 ({engine}): step {step} of at most 1,000, 2 still running"
            for step in (0, 50)
        ]


def test_an_episode_has_at_most_episode_length_steps(state):
    config = dataclasses.replace(SMALL, episode_length=7)
    for engine in ("gymnasium", "native"):  # Hopper pays about one per step
        result = evaluate_policies(policies_of(state), config, engine=engine, episodes=3)
        assert 5 < result["return_mean"] < 9


def test_of_several_seeds_the_mean_is_printed_with_its_spread_over_seeds():
    # means 10, 20, 30: standard deviation 10 (n - 1); a resample's mean lies between 10 and 30
    result = seed_statistics(
        [np.array([9.0, 11.0]), np.array([20.0, 20.0]), np.array([30.0, 30.0])]
    )
    assert (result["seeds_mean"], result["seeds_std"], result["iqm"]) == (20, 10, 20)
    assert 10 <= result["interval"][0] < 20 < result["interval"][1] <= 30
    text = describe(
        {
            "seeds": [0] * 3,
            "episodes": 6,
            "env": "Hopper-v4",
            "engine": "gymnasium",
            **result,
            "interval": [11.0, 29.0],
        }
    )
    assert text == (
        "return 20.0, mean of 3 seeds × 2 episodes of the deterministic policy in Hopper-v4 (gymnasium); standard deviation 10.0"
        " over seeds, 95 % interval of the mean 11.0 to 29.0"
    )


def test_returns_that_are_not_finite_have_a_summary_and_count_for_nothing_in_the_file_of_evaluations(
    tmp_path,
):
    result = summary(np.array([np.nan, np.inf, 1.0]))
    assert np.isnan(result["return_mean"])
    assert "nan" in describe(
        {"seeds": [result], "episodes": 3, "env": "Hopper-v4", "engine": "gymnasium", **result}
    )
    file = EvaluationsFile(tmp_path / "evaluations.jsonl")
    file.append(100, {"seeds": [{"seed": 0, **result}]})
    assert (file.best, EvaluationsFile(file.path).best) == (None, None)
    assert "NaN" not in file.path.read_text()
