"""Runs from Python."""

import dataclasses
import signal
from pathlib import Path

import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError, NoiseConfig
from dgae_jax.run import api, directory, logger
from dgae_jax.run.api import load_policy, train
from dgae_jax.run.episodes import episode_seeds, gymnasium_steps, make_eval_env
from dgae_jax.run.files import read_object
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


def test_run_directory_is_resumed_on_request(run_dir):
    with pytest.raises(ConfigError, match="must be a new or empty directory"):
        train(small(), run_dir, quiet=True, **CHOSEN)
    longer = dataclasses.replace(small(), total_steps=9 * 64)
    run = train(longer, str(run_dir), quiet=True, resume_or_start=True, **CHOSEN)
    assert (run.directory, len(run.metrics)) == (run_dir, ITERATIONS + 1)


@pytest.mark.slow
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
        (small(), {"eval_engine": "mujoco"}, "eval_engine mujoco: must be one of gymnasium, "),
    ],
)
def test_invalid_setting_is_refused_before_writing(config, options, message, tmp_path, monkeypatch):
    monkeypatch.setattr(api.tempfile, "tempdir", str(tmp_path))
    with pytest.raises(ConfigError, match=message):
        train(config, **options)
    with pytest.raises(TypeError, match="unexpected keyword argument 'episode'"):
        train(small(), episode=3)
    assert list(tmp_path.iterdir()) == []


def test_signal_raises_run_error_with_directory(tmp_path, monkeypatch):
    monkeypatch.setattr(api.tempfile, "tempdir", str(tmp_path))
    honest = logger.evaluate_policies

    def interrupted(*args, **how):
        monkeypatch.setattr(logger, "evaluate_policies", honest)
        signal.raise_signal(signal.SIGTERM)
        return honest(*args, **how)

    monkeypatch.setattr(logger, "evaluate_policies", interrupted)
    with pytest.raises(RunError, match="stopped by SIGTERM; continue with --resume ") as caught:
        train(small(), quiet=True, **CHOSEN)
    assert caught.value.exit_code == 143
    assert last(Path(str(caught.value).rpartition(" ")[2])).name == "steps_000000000256.msgpack"


def test_policy_takes_any_leading_axes(finished):
    policy, obs = load_policy(finished), observations(3, 2)
    actions, quantiles = policy(obs), policy.quantiles(obs)
    assert (type(actions), actions.shape, quantiles.shape) == (np.ndarray, (3, 2, 3), (3, 2, 1))
    np.testing.assert_allclose(policy(obs[1, 0]), actions[1, 0], atol=1e-6)
    assert (np.abs(actions) <= 1).all()
    for shape in [(12,), (11, 1), ()]:
        with pytest.raises(ValueError, match="the last axis must be 11"):
            policy(np.zeros(shape))


def test_policy_acts_as_evaluations_play(finished):
    env = make_eval_env(directory.read_config(finished))
    steps = gymnasium_steps([env], load_policy(finished), episode_seeds(0, 1))
    played = sum(step.reward[0] for step in steps)
    assert read_object(finished / "evaluation.json")["returns"] == [round(played, 4)]


def test_each_seed_has_its_policy(three_seeds):
    policies = [load_policy(three_seeds, seed=i) for i in range(3)]
    actions = [policy(observations(4)) for policy in policies]
    assert not np.array_equal(actions[0], actions[1])
    for seed in (3, -1, True, 1.0):
        with pytest.raises(ConfigError, match=r"seed .*: must be an index below num_seeds"):
            load_policy(three_seeds, seed=seed)


def test_unknown_choice_of_checkpoint_is_refused(finished):
    with pytest.raises(ConfigError, match="last: must be one of latest, best"):
        load_policy(finished, "last")
