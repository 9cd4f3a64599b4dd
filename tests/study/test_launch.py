"""Launchers of a sweep."""

import os

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.study import launch
from dgae_jax.study.launch import LaunchOptions, launcher, slurm_parameters


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"launcher": "cloud"}, "launcher cloud: must be one of local, ray, slurm"),
        ({"processes": 0}, "processes 0: must be from 1 to 1,024"),
        ({"launcher": "ray", "processes": 2}, "processes 2: must be unset"),
        ({"address": "auto"}, "address auto: must be unset"),
        ({"launcher": "ray", "address": "head"}, "address head: must be auto, or HOST:PORT"),
        ({"launcher": "ray", "cpus_per_run": 0}, "cpus_per_run 0: must be from 1"),
        ({"launcher": "ray", "gpus_per_run": -1}, "gpus_per_run -1: must be from 0 to 64"),
    ],
)
def test_an_invalid_option_is_refused_before_anything_starts(options, message):
    with pytest.raises(ConfigError, match=message):
        launcher(LaunchOptions(**options))


def test_slurm_is_refused_where_there_is_none(monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ConfigError, match="launcher slurm: must be used where Slurm is"):
        launcher(LaunchOptions(launcher="slurm"))


def test_slurm_settings_are_given_as_name_and_value():
    options = LaunchOptions(slurm=("partition=gpu", "time=60"))
    assert slurm_parameters(options) == {"slurm_partition": "gpu", "slurm_time": 60}
    with pytest.raises(ConfigError, match="slurm gpu: must be NAME=VALUE"):
        slurm_parameters(LaunchOptions(slurm=("gpu",)))


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
