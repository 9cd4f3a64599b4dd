"""Evaluation: episodes in every engine, statistics of their returns."""

import dataclasses

import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError, NoiseConfig
from dgae_jax.learn.build import make_task, policies_of, seed_keys
from dgae_jax.learn.parallel import make_trainer
from dgae_jax.run import episodes
from dgae_jax.run.evaluation import (
    describe,
    evaluate_policies,
    seed_statistics,
    summary,
)
from dgae_jax.run.options import engines_of
from tests.runs import SMALL

ENGINES = ["gymnasium", "native"]


def policies(config):
    return policies_of(make_trainer(make_task(config), 1).init(config, seed_keys(config)))


def test_engines_of_a_run():
    assert engines_of(SMALL)[0] == "gymnasium"
    assert {"native", "jax"} <= set(engines_of(SMALL))
    ant = dataclasses.replace(SMALL, env="brax:ant", physics="mjx")
    assert engines_of(ant) == ("mjx",)
    with pytest.raises(ConfigError, match="engine gymnasium: must be one of mjx with brax:ant"):
        evaluate_policies(None, ant, engine="gymnasium", episodes=1)


@pytest.mark.parametrize("engine", ENGINES)
def test_each_seed_is_reported(engine):
    config = dataclasses.replace(SMALL, num_seeds=2, seed=3, episode_length=7)
    result = evaluate_policies(policies(config), config, engine=engine, episodes=5)
    assert result["episodes"] == len(result["returns"]) == 10
    assert [s["seed"] for s in result["seeds"]] == [3, 4]
    assert result["returns"] == result["seeds"][0]["returns"] + result["seeds"][1]["returns"]
    assert result["return_mean"] == pytest.approx(np.mean(result["returns"]), rel=1e-4)
    assert result["return_std"] == pytest.approx(np.std(result["returns"]), rel=1e-3)
    assert 5 < result["return_mean"] < 9  # about one per step


def test_native_and_gymnasium_agree(state):
    ours, theirs = (
        evaluate_policies(policies_of(state), SMALL, engine=engine, episodes=40)
        for engine in ("native", "gymnasium")
    )
    error = (ours["return_std"] ** 2 + theirs["return_std"] ** 2) ** 0.5 / 40**0.5
    assert abs(ours["return_mean"] - theirs["return_mean"]) < 4 * error


def test_only_own_engines_play_with_noise(state):
    noisy, how = dataclasses.replace(SMALL, noise=NoiseConfig(reward=100.0)), {"episodes": 1}
    calm, own = (evaluate_policies(policies_of(state), noisy, engine=x, **how) for x in ENGINES)
    # some ten steps, each with a reward of 1 or 2
    assert abs(own["return_mean"]) > 100 > calm["return_mean"] > 0


@pytest.mark.parametrize("engine", ENGINES)
def test_seed_determines_the_episodes(engine, state):
    def returns(seed, count=6):
        how = {"engine": engine, "episodes": count, "seed": seed}
        return evaluate_policies(policies_of(state), SMALL, **how)["returns"]

    assert returns(0) == returns(0)
    assert not set(returns(0)) & set(returns(1))
    np.testing.assert_allclose(returns(0, 3), returns(0)[:3], rtol=1e-3)
    numbers = np.concatenate([episodes.episode_seeds(seed, 50) for seed in range(20)])
    assert len(set(numbers.tolist())) == 1000


def test_evaluation_reports_progress_and_can_be_broken_off():
    said = []

    def watch(text):
        said.append(text)
        if "step 50" in text:
            raise KeyboardInterrupt

    config = dataclasses.replace(SMALL, env="swimmer")  # which never falls
    swimmers = policies(config)
    for engine in ENGINES:
        how = {"engine": engine, "episodes": 2, "watch": watch}
        with pytest.raises(KeyboardInterrupt):
            evaluate_policies(swimmers, config, **how)
        start = f"evaluating 2 episodes in Swimmer-v4 ({engine}): step "
        assert said[-2:] == [f"{start}{n} of at most 1,000, 2 still running" for n in (0, 50)]


def test_gymnasium_steps_begin_with_the_observation_of_each_env():
    envs, qpos = [episodes.make_eval_env(SMALL, 5) for _ in range(2)], []

    def act(obs):
        qpos.append([env.unwrapped.data.qpos.copy() for env in envs])
        return np.zeros((2, 3))

    steps = list(episodes.gymnasium_steps(envs, act, [1, 2]))
    assert [step.alive.all() for step in steps] == [True] * 4 + [False]
    assert not steps[-1].terminated.any()  # cut off by the time limit
    for step, positions in zip(steps, qpos, strict=True):  # all positions but x come first
        np.testing.assert_allclose(step.obs[:, :5], np.array(positions)[:, 1:])


ABOUT = {"episodes": 6, "env": "Hopper-v4", "engine": "gymnasium"}


def test_several_seeds_are_described_with_their_spread():
    # means 10, 20, 30: standard deviation 10 (n - 1); a resample's mean lies between 10 and 30
    result = seed_statistics([np.array(pair) for pair in ([9.0, 11.0], [20.0, 20.0], [30.0, 30.0])])
    assert (result["seeds_mean"], result["seeds_std"], result["iqm"]) == (20, 10, 20)
    assert 10 <= result["interval"][0] < 20 < result["interval"][1] <= 30
    text = describe({**ABOUT, **result, "seeds": [0] * 3})
    assert text.startswith("return 20.0, mean of 3 seeds × 2 episodes of the deterministic policy")
    assert "standard deviation 10.0 over seeds" in text


def test_nonfinite_returns_are_described():
    result = summary(np.array([np.nan, np.inf, 1.0]))
    assert "return nan ± nan over 6 episodes" in describe({**ABOUT, **result, "seeds": [0]})
