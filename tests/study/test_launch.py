"""Who trains the cells."""

import os
import socket

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.study import launch, on_slurm
from dgae_jax.study.launch import LaunchOptions, launcher


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"launcher": "cloud"}, "launcher cloud: must be one of local, ray, slurm"),
        ({"processes": 0}, "processes 0: must be a whole number from 1 to 1,024"),
        ({"launcher": "ray", "processes": 2}, "processes 2: must be left out with --launcher ray"),
        ({"address": "auto"}, "address auto: must be left out with --launcher local"),
        (
            {"launcher": "ray", "address": "head"},
            "address head: must be HOST:PORT of a cluster, or auto",
        ),
        (
            {"launcher": "ray", "cpus_per_run": 0},
            "cpus_per_run 0: must be a whole number from 1 to 1,024",
        ),
        ({"launcher": "ray", "gpus_per_run": -1}, "gpus_per_run -1: must be from 0 to 64"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_before_anything_starts(options, message):
    with pytest.raises(ConfigError, match=message):
        launcher(LaunchOptions(**options))


def test_a_ray_cluster_that_does_not_answer_is_refused_within_seconds():
    pytest.importorskip("ray")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(
        ConfigError, match=rf"address 127\.0\.0\.1:{port}: must be where a Ray cluster answers"
    ):
        launcher(LaunchOptions(launcher="ray", address=f"127.0.0.1:{port}"))


def test_slurm_is_refused_where_there_is_none(monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ConfigError, match="launcher slurm: must be used where Slurm is"):
        launcher(LaunchOptions(launcher="slurm"))


def test_what_slurm_is_told_is_written_as_name_and_value():
    assert on_slurm.parameters(["partition=gpu", "time=60"]) == {
        "slurm_partition": "gpu",
        "slurm_time": 60,
    }
    with pytest.raises(ConfigError, match="slurm gpu: must be NAME=VALUE"):
        on_slurm.parameters(["gpu"])


def test_cores_are_divided_between_processes_and_shared_where_there_are_too_few(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {4, 5, 6}, raising=False)
    assert launch._shares(3) == [[4], [5], [6]]
    assert launch._shares(2) == [
        [4],
        [5],
    ]  # as many for each: a cell goes on with the number that it was begun with
    assert launch._shares(4) == [[4], [5], [6], [4]]
    assert launch._shares(1) == [[]]
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(5)), raising=False)
    assert launch._shares(2) == [[0, 1], [2, 3]]
