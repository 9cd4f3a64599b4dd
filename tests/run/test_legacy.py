"""Files of older versions: a run directory with schema 3 checkpoints and its policy file."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

import dgae_jax as dg
from dgae_jax.run import directory
from dgae_jax.run.evaluation import evaluate_run
from tests.helpers import ROOT
from tests.runs import exit_code

LEGACY = ROOT / "tests" / "data" / "schema3"
OBS = np.linspace(-1, 1, 11)
ACTION = [-0.00250137, 0.01358729, -0.01302013]


def test_old_configuration_is_read_in_new_names():
    config = directory.read_config(LEGACY / "run")
    assert (config.num_steps, config.gae_lambda) == (16, 0.95)
    assert config.policy.options["clip_eps"] == 0.2


@pytest.mark.parametrize("name", ["run", "policy.msgpack"])
def test_old_policy_acts_as_it_did(name):
    policy = dg.load_policy(LEGACY / name)
    np.testing.assert_allclose(policy(OBS), ACTION, rtol=1e-4)
    assert policy.quantiles(OBS).shape == (8,)


def test_old_run_is_evaluated_to_the_same_return():
    config = directory.read_config(LEGACY / "run")
    result = evaluate_run(LEGACY / "run", config, which="latest", episodes=1)
    then = json.loads((LEGACY / "run" / "evaluation.json").read_text())
    np.testing.assert_allclose(result["returns"], then["returns"], rtol=1e-4)


def test_old_run_is_resumed(tmp_path):
    old_run = shutil.copytree(LEGACY / "run", tmp_path / "run")
    config = dataclasses.replace(directory.read_config(old_run), total_steps=384)
    assert exit_code(config, resume=old_run, inexact=True) == 0
    assert (old_run / "checkpoints" / "steps_000000000384.msgpack").exists()
    assert json.loads((old_run / "config.json").read_text())["schema"] == 3
