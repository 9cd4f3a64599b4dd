"""Whole runs on custom envs and on tasks of Gymnasium and Playground."""

import dataclasses
import json
from importlib.util import find_spec

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.run import checkpoint, training
from dgae_jax.run.episodes import time_limit
from dgae_jax.run.options import RunOptions, engines_of
from tests.probes import Counter, Target
from tests.runs import QUIET, small

CHOSEN = {"cache_dir": QUIET.cache_dir, "episodes": 1, "quiet": True}


def config_for(env="hopper", **changes):
    short = {"env": env, "physics": None, "env_version": None, "total_steps": 128}
    return small().as_config().replace(**{**short, **changes})


PENDULUM = config_for("gymnasium:Pendulum-v1")


def test_impossible_gymnasium_run_is_refused_before_writing(tmp_path):
    message = "devices 2: must be 1, in one process with JAX_PLATFORMS=cpu, with gymnasium:Pend"
    with pytest.raises(ConfigError, match=message):
        dg.train(PENDULUM, tmp_path / "run", devices=2, **CHOSEN)
    message = "env gymnasium:Nope-v1: must be a task that can be built .*NameNotFound"
    with pytest.raises(ConfigError, match=message):
        dg.train(config_for("gymnasium:Nope-v1"), tmp_path / "run", **CHOSEN)
    assert list(tmp_path.iterdir()) == []


def test_shorter_time_limit_of_gymnasium_comes_first():
    config = resolve(PENDULUM)
    assert engines_of(config) == ("gymnasium",)
    limits = [time_limit(dataclasses.replace(config, episode_length=n)) for n in (20, 1000)]
    assert limits == [20, 200]


@pytest.mark.slow
def test_custom_env_is_needed_again_to_load(tmp_path):
    other = dg.train(config_for(), env=Counter(3), **CHOSEN)  # of the same name
    assert other.evaluation["returns"] == [6.0]
    run = dg.train(config_for(), tmp_path / "run", env=Counter(), **CHOSEN)
    assert run.evaluation["env"] == "custom:Counter"
    assert run.evaluation["returns"] == [210.0]  # 1 + 2 + … + 20
    obs = np.ones((5, 2))
    assert_array_equal(dg.load_policy(tmp_path / "run", env=Counter())(obs), run.policy(obs))
    for env in (None, Target()):
        with pytest.raises(ConfigError, match="env custom:Counter: must be given as an object"):
            dg.load_policy(tmp_path / "run", env=env)


@pytest.mark.slow
def test_gymnasium_task_is_learnt():
    config = dg.preset("tuned", "dppo", "gymnasium:InvertedPendulum-v5")
    config = dataclasses.replace(config, num_envs=8, num_steps=64, total_steps=20_480)
    run = dg.train(config, quiet=True, episodes=10)
    assert run.metrics[0]["episode_return"] < 50  # a reward of 1 for every step that it stands
    assert run.evaluation["return_mean"] > 500


@pytest.mark.slow
def test_gymnasium_run_repeats_and_resumes_in_new_episodes(tmp_path, capsys):
    config = resolve(PENDULUM.replace(num_seeds=2, total_steps=64, episode_length=1000))
    rows = [dg.train(config, tmp_path / name, **CHOSEN).metrics for name in "ab"]
    assert [{**row, "seconds": 0} for row in rows[0]] == [{**row, "seconds": 0} for row in rows[1]]
    options = RunOptions(resume=tmp_path / "a", cache_dir=QUIET.cache_dir, episodes=1)
    longer = dataclasses.replace(config, total_steps=128)
    with pytest.raises(ConfigError, match=r"not bit-identical \(the envs of gymnasium:Pend"):
        training.train(longer, options)
    training.train(longer, dataclasses.replace(options, inexact=True))
    assert "begin new episodes: the run is not bit-identical" in capsys.readouterr().err
    assert len((tmp_path / "a" / "metrics.jsonl").read_text().splitlines()) == 4
    state, _ = checkpoint.latest_train_state(tmp_path / "a", longer)
    assert_array_equal(state.episodes.steps, np.full((2, 4), 16))  # 32 if they had gone on


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco_playground") is None, reason="playground is not installed")
@pytest.mark.filterwarnings("default")
def test_playground_task_is_trained_and_evaluated_on_mjx(tmp_path):
    run = dg.train(config_for("playground:CartpoleBalance"), tmp_path / "run", **CHOSEN)
    assert (run.evaluation["engine"], len(run.metrics)) == ("mjx", 2)
    assert 0 < run.evaluation["return_mean"] <= 20  # a reward between 0 and 1
    assert json.loads((tmp_path / "run" / "config.json").read_text())["physics"] == "mjx"
