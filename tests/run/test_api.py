"""Runs from Python."""

import dataclasses
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import api, directory, logger
from dgae_jax.run.api import load_policy, train
from dgae_jax.run.episodes import episode_seeds, gymnasium_steps, make_eval_env
from dgae_jax.run.files import read_object
from dgae_jax.run.training import RunError
from tests.runs import ITERATIONS, QUIET, exit_code, last, small, timeless

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


def test_resume_or_start_does_either(tmp_path):
    half = dataclasses.replace(small(), total_steps=4 * 64)
    for config in (half, small()):
        run = train(config, str(tmp_path / "run"), quiet=True, resume_or_start=True, **CHOSEN)
    assert (run.directory, len(run.metrics)) == (tmp_path / "run", ITERATIONS)
    assert len(read_object(run.directory / "manifest.json")["resumed"]) == 1
    with pytest.raises(ConfigError, match="resume_or_start True: must be used with --run-dir DIR"):
        exit_code(small(), resume_or_start=True)


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


def test_run_error_names_the_directory_that_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(api.tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(logger, "evaluate_policies", Mock(side_effect=MemoryError))
    with pytest.raises(RunError, match=r"stopped: out of memory .* with --resume ") as caught:
        train(small(), quiet=True, **CHOSEN)
    assert caught.value.exit_code == 1
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
    with pytest.raises(ConfigError, match="last: must be one of latest, best"):
        load_policy(three_seeds, "last")
