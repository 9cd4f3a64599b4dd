"""Whole runs on tasks of other people."""

import dataclasses
import json
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.run import checkpoint, training
from dgae_jax.run.evaluation import time_limit
from dgae_jax.run.options import RunOptions, engines_of
from tests.helpers import command
from tests.probes import Counter, Target
from tests.runs import QUIET, small

PENDULUM = dataclasses.replace(
    small(), env="gymnasium:Pendulum-v1", physics=None, env_version=None, total_steps=128
)
CHOSEN = {"cache_dir": QUIET.cache_dir, "episodes": 1, "quiet": True}


def given(**changes):
    return dataclasses.replace(small(), physics=None, env_version=None, total_steps=128, **changes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"devices": 2},
            "devices 2: must be 1 with gymnasium:Pendulum-v1, whose worlds are stepped one after the other in one process",
        ),
        ({}, "env gymnasium:Nope-v1: must be a task that can be built on gymnasium .*NameNotFound"),
    ],
)
def test_what_cannot_work_in_gymnasium_is_refused_before_anything_is_written(
    options, message, tmp_path
):
    config = PENDULUM if options else dataclasses.replace(PENDULUM, env="gymnasium:Nope-v1")
    with pytest.raises(ConfigError, match=message):
        training.train(
            config, RunOptions(run_dir=tmp_path / "run", cache_dir=QUIET.cache_dir, **options)
        )
    assert list(tmp_path.iterdir()) == []


def test_a_task_of_gymnasiums_is_evaluated_there_with_the_shorter_of_two_time_limits():
    assert engines_of(PENDULUM) == ("gymnasium",)
    assert [time_limit(dataclasses.replace(PENDULUM, episode_length=n)) for n in (20, 1000)] == [
        20,
        200,
    ]


@pytest.mark.slow
def test_a_run_on_an_object_is_a_whole_run_and_needs_the_object_again(tmp_path):
    run = dg.train(given(episode_length=20), tmp_path / "run", env=Counter(), **CHOSEN)
    assert run.evaluation["env"] == "custom:Counter"
    assert run.evaluation["returns"] == [210.0]  # 1 + 2 + … + 20
    obs = np.ones((5, 2))
    assert_array_equal(dg.load_policy(tmp_path / "run", env=Counter())(obs), run.policy(obs))
    with pytest.raises(
        ConfigError, match="env custom:Counter: must be given as an object from Python"
    ):
        dg.load_policy(tmp_path / "run")
    with pytest.raises(
        ConfigError, match="env custom:Counter: must be given as an object from Python"
    ):
        dg.load_policy(tmp_path / "run", env=Target())


@pytest.mark.slow
def test_another_object_of_the_same_name_is_not_mistaken_for_the_first(tmp_path):
    returns = [
        dg.train(given(episode_length=20), env=Counter(length), **CHOSEN).evaluation["returns"]
        for length in (3, 4)
    ]
    assert returns == [[6.0], [10.0]]


@pytest.mark.slow
def test_a_task_of_gymnasiums_is_learnt():
    config = dg.preset("tuned", "dppo", "gymnasium:InvertedPendulum-v5")
    run = dg.train(
        dataclasses.replace(config, num_envs=8, num_steps=64, total_steps=20_480),
        quiet=True,
        episodes=10,
    )
    assert run.metrics[0]["episode_return"] < 50  # a reward of 1 for every step that it stands
    assert run.evaluation["return_mean"] > 500


@pytest.mark.slow
def test_a_run_in_gymnasium_is_the_same_again_and_goes_on_in_new_episodes_if_asked_to(
    tmp_path, capsys
):
    config = dataclasses.replace(PENDULUM, num_seeds=2, total_steps=64, episode_length=1000)
    rows = [dg.train(config, tmp_path / name, **CHOSEN).metrics for name in "ab"]
    assert [{**row, "seconds": 0} for row in rows[0]] == [{**row, "seconds": 0} for row in rows[1]]
    options = RunOptions(resume=tmp_path / "a", cache_dir=QUIET.cache_dir, episodes=1)
    longer = dataclasses.replace(config, total_steps=128)
    with pytest.raises(
        ConfigError,
        match="must be with --inexact; the worlds of gymnasium:Pendulum-v1 are not in a checkpoint",
    ):
        training.train(longer, options)
    training.train(longer, dataclasses.replace(options, inexact=True))
    assert "begin new episodes, so the rest is another sample" in capsys.readouterr().err
    assert len((tmp_path / "a" / "metrics.jsonl").read_text().splitlines()) == 4
    state, _ = checkpoint.latest_train_state(tmp_path / "a", resolve(longer))
    assert_array_equal(state.episodes.steps, np.full((2, 4), 16))  # 32 if they had gone on


@pytest.mark.slow
def test_a_policy_learnt_in_gymnasium_is_exported_and_plays_there_the_same(
    tmp_path, monkeypatch, capsys
):
    run = dg.train(PENDULUM, tmp_path / "run", **CHOSEN)
    monkeypatch.setattr(
        sys,
        "argv",
        ["export", str(tmp_path / "run"), "--to", "gymnasium", "--out", str(tmp_path / "out")],
    )
    assert command("export")() == 0
    agent = [sys.executable, "agent.py", "--episodes", "1"]
    directory = tmp_path / "out" / "gymnasium"
    done = subprocess.run(agent, cwd=directory, capture_output=True, text=True, check=True)
    played = float(done.stdout.split()[3])
    assert played == pytest.approx(run.evaluation["returns"][0], rel=1e-4)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco_playground") is None, reason="playground is not installed")
@pytest.mark.filterwarnings("default")
def test_a_task_of_playgrounds_is_trained_on_and_evaluated_on_mjx(tmp_path):
    run = dg.train(
        given(env="playground:CartpoleBalance", episode_length=20), tmp_path / "run", **CHOSEN
    )
    assert (run.evaluation["engine"], len(run.metrics)) == ("mjx", 2)
    assert 0 < run.evaluation["return_mean"] <= 20  # a reward between 0 and 1
    assert json.loads((tmp_path / "run" / "config.json").read_text())["physics"] == "mjx"
