"""A training state, a finished run and a copy of it."""

import shutil
from functools import cache

import pytest

from dgae_jax.learn.build import make_task, seed_keys
from dgae_jax.learn.parallel import make_trainer
from dgae_jax.run import training
from tests.runs import SMALL, exit_code, small


@pytest.fixture(scope="session", autouse=True)
def _compiled_once():
    """Share the program of runs of the same configuration."""
    with pytest.MonkeyPatch.context() as patch:
        for make in (training.make_task, training.make_trainer):
            patch.setattr(training, make.__name__, cache(make))
        yield


@pytest.fixture(scope="session")
def state():
    return make_trainer(make_task(SMALL), 1).init(SMALL, seed_keys(SMALL))


def trained(run_dir, config):
    assert exit_code(config, run_dir=run_dir) == 0
    return run_dir


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("runs") / "finished", small())


@pytest.fixture(scope="session")
def three_seeds(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("runs") / "three", small("a2c", seeds=3))


@pytest.fixture
def run_dir(finished, tmp_path):
    """A copy of the finished run."""
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"
