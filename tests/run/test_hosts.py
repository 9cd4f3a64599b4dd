"""Two processes that share a run, as on two hosts: they meet on the loopback device."""

import json
import signal
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from dgae_jax.run import checkpoint, directory, runtime
from dgae_jax.run.options import RunOptions
from tests.helpers import ROOT, TINY
from tests.runs import last, stopped_half_way, timeless

FLAGS = [*TINY, "--total-steps", "512", "--checkpoint-every", "256", "--episodes", "1"]


def begun(*flags):
    command = [sys.executable, ROOT / "experiments" / "train.py", *map(str, flags)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def pair(*flags):
    """Both processes of a run."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{free.getsockname()[1]}"
    return [
        begun("--coordinator", where, "--num-processes", 2, "--process-id", i, *flags)
        for i in range(2)
    ]


def finished(processes):
    return [(*process.communicate(timeout=300), process.returncode) for process in processes]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("hosts") / "whole"
    (out, err, code), (other_out, other_err, other) = finished(pair(*FLAGS, "--run-dir", run_dir))
    assert (code, other) == (0, 0), err + other_err
    assert f"files in {run_dir}" in out
    assert "dgae_jax" not in other_out
    return run_dir


def arrays(run_dir):
    state, _ = checkpoint.latest_train_state(run_dir, directory.read_config(run_dir))
    return checkpoint.arrays_of(state)


def test_two_processes_find_what_one_finds_with_two_devices(whole, tmp_path):
    ((_, err, code),) = finished([begun(*FLAGS, "--devices", 2, "--run-dir", tmp_path / "one")])
    assert code == 0, err
    ours, theirs = arrays(whole), arrays(tmp_path / "one")
    for name, x in theirs.items():
        np.testing.assert_allclose(ours[name], x, atol=1e-5, err_msg=name)
    returns = [
        json.loads((d / "evaluation.json").read_text())["returns"]
        for d in (whole, tmp_path / "one")
    ]
    np.testing.assert_allclose(*returns, rtol=1e-5)


@pytest.mark.slow
def test_a_run_of_two_processes_goes_on_bit_for_bit(whole, tmp_path):
    half = tmp_path / "half"
    stopped_half_way(whole, half)
    for _, err, code in finished(pair("--resume", half, *TINY[-2:])):
        assert code == 0, err
    assert last(half).read_bytes() == last(whole).read_bytes()
    assert timeless(half) == timeless(whole)


def test_devices_of_all_processes_must_come_out_even(tmp_path):
    for _, err, code in finished(pair(*FLAGS, "--devices", "3", "--run-dir", tmp_path / "run")):
        assert code == 2
        assert (
            "error: --devices 3: must be a number that divides num_envs 4 or num_seeds 1 in each of 2 processes\n"
            in err
        )


def test_a_signal_to_any_of_them_stops_all_with_one_checkpoint(tmp_path):
    run_dir = tmp_path / "run"
    processes = pair(*TINY, "--total-steps", "100_000_000", "--run-dir", run_dir)
    while (
        not (run_dir / "metrics.jsonl").exists() or not (run_dir / "metrics.jsonl").stat().st_size
    ):
        time.sleep(0.2)
        assert all(process.poll() is None for process in processes), finished(processes)
    processes[1].send_signal(signal.SIGTERM)
    (out, _, code), (_, _, other) = finished(processes)
    assert (code, other) == (143, 143)
    assert f"stopped by SIGTERM; continue with --resume {run_dir}" in out
    (saved,) = (run_dir / "checkpoints").iterdir()
    assert saved.name == f"steps_{timeless(run_dir)[-1]['steps']:012d}.msgpack"


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (("--coordinator", "here"), "--coordinator here: must be HOST:PORT"),
        (
            ("--coordinator", "localhost:1", "--num-processes", "2"),
            "--process-id None: must be given with --coordinator",
        ),
        (
            ("--coordinator", "localhost:1", "--num-processes", "2", "--process-id", "2"),
            "--process-id 2: must be below --num-processes 2",
        ),
        (("--num-processes", "2"), "--num-processes 2: must be left out without --coordinator"),
        (("--process-id", "0"), "--process-id 0: must be left out without --coordinator"),
    ],
)
def test_what_does_not_name_a_meeting_is_refused_in_one_line(flags, reason, tmp_path):
    ((_, err, code),) = finished([begun(*TINY, *flags, "--run-dir", tmp_path / "run")])
    assert (code, err) == (2, f"error: {reason}\n")


SCHEDULERS = (
    "SLURM_NTASKS",
    "OMPI_COMM_WORLD_SIZE",
    "TPU_WORKER_HOSTNAMES",
    "KUBERNETES_SERVICE_HOST",
    "JOB_COMPLETION_INDEX",
)


@pytest.mark.parametrize(
    ("environment", "several"),
    [
        ({}, False),
        ({"SLURM_NTASKS": "1"}, False),
        ({"SLURM_NTASKS": "2"}, True),
        ({"OMPI_COMM_WORLD_SIZE": "4"}, True),
        ({"TPU_WORKER_HOSTNAMES": "one"}, False),
        ({"TPU_WORKER_HOSTNAMES": "one,two"}, True),
        ({"KUBERNETES_SERVICE_HOST": "here"}, False),
        ({"KUBERNETES_SERVICE_HOST": "here", "JOB_COMPLETION_INDEX": "0"}, True),
    ],
)
def test_processes_are_expected_where_a_scheduler_started_several(
    environment, several, monkeypatch
):
    for name in SCHEDULERS:
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    met = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *where: met.append(where))
    runtime.join_processes(RunOptions())
    assert met == ([(None, None, None)] if several else [])
    runtime.join_processes(RunOptions(num_processes=1))
    assert len(met) == several
