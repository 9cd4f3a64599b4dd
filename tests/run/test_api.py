"""Runs from Python."""

import dataclasses
import signal
from pathlib import Path

import jax
import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError, NoiseConfig
from dgae_jax.learn.build import make_greedy, make_task
from dgae_jax.run import api, checkpoint, directory, episodes, logger
from dgae_jax.run.api import load_policy, train
from dgae_jax.run.evaluation import evaluate_policies
from dgae_jax.run.training import RunError
from tests.runs import ITERATIONS, QUIET, last, small, timeless

CHOSEN = {"cache_dir": QUIET.cache_dir, "episodes": 1, "checkpoint_every": QUIET.checkpoint_every}


def observations(*shape):
    return np.random.default_rng(0).normal(size=(*shape, 11)).astype(np.float32)


def test_run_without_directory_leaves_no_files(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(api.tempfile, "tempdir", str(tmp_path))
    run = train(small(), quiet=True, **CHOSEN)
    assert capsys.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []
    assert run.directory is None
    returns = [row["episode_return"] for row in run.metrics]
    assert returns == [row["episode_return"] for row in timeless(finished)]
    assert run.evaluation["episodes"] == 1
    obs = observations(5)
    np.testing.assert_array_equal(run.policy(obs), load_policy(finished)(obs))


def test_run_directory_is_resumed_on_request(tmp_path):
    run_dir = tmp_path / "run"
    config = dataclasses.replace(small(), total_steps=small().total_steps // 2)
    assert train(config, run_dir, quiet=True, **CHOSEN).directory == run_dir
    with pytest.raises(ConfigError, match="must be a new or empty directory"):
        train(small(), run_dir, quiet=True, **CHOSEN)
    run = train(small(), str(run_dir), quiet=True, resume_or_start=True, **CHOSEN)
    assert (run.directory, len(run.metrics)) == (run_dir, ITERATIONS)
    assert directory.read_config(run_dir).total_steps == small().total_steps


def test_own_engines_are_evaluated_with_noise():
    config = dataclasses.replace(small(), noise=NoiseConfig(reward=100.0))
    noisy, calm = (
        train(config, quiet=True, eval_engine=engine, **CHOSEN).evaluation
        for engine in ("native", "gymnasium")
    )
    assert (noisy["engine"], calm["engine"]) == ("native", "gymnasium")
    # some ten steps, each with a reward of 1 or 2
    assert abs(noisy["return_mean"]) > 100 > calm["return_mean"] > 0


@pytest.mark.parametrize(
    ("config", "options", "message"),
    [
        (small().as_config().replace(gamma=1.5), {}, "gamma 1.5: must be"),
        (small(), {"checkpoint_every": 5e4}, r"checkpoint_every 50000\.0: must be a whole number"),
        (small(), {"episodes": 0}, "episodes 0: must be a whole number"),
        (small(), {"eval_engine": "mujoco"}, "eval_engine mujoco: must be one of gymnasium, "),
        (small(), {"episode": 3}, "episode: must be one of cache_dir, "),
        (small(), {"resume": "x"}, "resume: must be one of cache_dir, "),
    ],
)
def test_invalid_setting_is_refused_before_writing(config, options, message, tmp_path, monkeypatch):
    monkeypatch.setattr(api.tempfile, "tempdir", str(tmp_path))
    with pytest.raises(ConfigError, match=message):
        train(config, **options)
    assert list(tmp_path.iterdir()) == []


def test_signal_raises_run_error_with_directory(tmp_path, monkeypatch):
    monkeypatch.setattr(api.tempfile, "tempdir", str(tmp_path))
    honest = logger.evaluate_policies

    def interrupted(*args, **how):
        signal.raise_signal(signal.SIGTERM)
        honest(*args, **how)
        pytest.fail("the evaluation continued")

    monkeypatch.setattr(logger, "evaluate_policies", interrupted)
    with pytest.raises(RunError, match="stopped by SIGTERM; continue with --resume ") as caught:
        train(small(), quiet=True, **CHOSEN)
    assert caught.value.exit_code == 143
    assert last(Path(str(caught.value).rpartition(" ")[2])).name == "steps_000000000256.msgpack"


@pytest.mark.parametrize("shape", [(), (7,), (3, 2)])
def test_policy_takes_any_leading_axes(shape, finished):
    policy = load_policy(finished)
    obs = observations(*shape)
    actions, quantiles = policy(obs), policy.quantiles(obs)
    assert (type(actions), actions.shape, quantiles.shape) == (np.ndarray, (*shape, 3), (*shape, 1))
    one_by_one = np.array([policy(each) for each in obs.reshape(-1, 11)]).reshape(actions.shape)
    np.testing.assert_allclose(actions, one_by_one, atol=1e-6)
    assert (np.abs(actions) <= 1).all()


@pytest.mark.parametrize("shape", [(12,), (11, 1), ()])
def test_observations_of_other_size_are_refused(shape, finished):
    with pytest.raises(ValueError, match="the last axis must be 11"):
        load_policy(finished)(np.zeros(shape))


def test_policy_acts_as_evaluations_play(finished, monkeypatch):
    config, seen = directory.read_config(finished), []
    policies = checkpoint.load_networks(finished, config, "latest").policy
    greedy = jax.jit(make_greedy(make_task(config), config))

    def watched(policy, obs):
        seen.append((obs, np.asarray(greedy(policy, obs))))
        return seen[-1][1]

    watched.lower = greedy.lower
    monkeypatch.setattr(episodes, "_greedy", lambda *_: watched)
    evaluate_policies(policies, config, episodes=4)
    policy = load_policy(finished)
    assert len(seen) > 5
    for obs, action in seen:
        np.testing.assert_array_equal(policy(obs), action)


def test_each_seed_has_its_policy(tmp_path):
    train(small("ppo", seeds=3), tmp_path / "run", quiet=True, **CHOSEN)
    policies = [load_policy(tmp_path / "run", seed=i) for i in range(3)]
    actions = [policy(observations(4)) for policy in policies]
    assert not np.array_equal(actions[0], actions[1])
    for seed in (3, -1, True, 1.0):
        with pytest.raises(ConfigError, match=r"seed .*: must be a whole number from 0 to 2"):
            load_policy(tmp_path / "run", seed=seed)


def test_unknown_choice_of_checkpoint_is_refused(finished, tmp_path):
    with pytest.raises(ConfigError, match="last: must be one of latest, best"):
        load_policy(finished, "last")
    with pytest.raises(ConfigError, match=r"config\.json: must be a configuration that can be"):
        load_policy(tmp_path)
