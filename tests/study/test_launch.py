"""Launchers of a sweep."""

import os

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.study import launch
from dgae_jax.study.worker import Job


def test_settings_that_slurm_does_not_know_are_refused(tmp_path, monkeypatch):
    submitit = pytest.importorskip("submitit")
    executor = submitit.AutoExecutor
    monkeypatch.setattr(submitit, "AutoExecutor", lambda folder, _: executor(folder, "local"))
    jobs = [Job("one", print, (), tmp_path / "logs" / "one.log")]
    message = "launcher slurm: must be used with settings .*Unknown argument 'gpu'"
    with pytest.raises(ConfigError, match=message), launch.slurm_array(jobs, 1, 0, ["gpu"]):
        pass


@pytest.mark.parametrize(
    ("cores", "processes", "shares"),
    [
        ({4, 5, 6}, 3, [[4], [5], [6]]),
        ({4, 5, 6}, 2, [[4], [5]]),
        ({4, 5, 6}, 4, [[4], [5], [6], [4]]),
        ({4, 5, 6}, 1, [[]]),
        ({0, 1, 2, 3, 4}, 2, [[0, 1], [2, 3]]),
    ],
)
def test_every_process_has_as_many_cores(monkeypatch, cores, processes, shares):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: cores, raising=False)
    assert launch._shares(processes) == shares
