"""Devices, processes, kills and signals; two processes in place of several hosts."""

import importlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from unittest.mock import Mock

import jax
import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import checkpoint, directory, runtime
from dgae_jax.run.options import RunOptions
from dgae_jax.run.runtime import Signals, Stopped
from tests.helpers import ROOT, TINY
from tests.runs import SMALL, assert_same, each_signal, last, stopped_half_way, timeless

FLAGS = [*TINY, "--total-steps", "512", "--checkpoint-every", "256", "--episodes", "1"]
CACHE = TINY[-2:]


def begun(*flags, out=subprocess.PIPE):
    command = [sys.executable, ROOT / "experiments" / "train.py", *map(str, flags)]
    return subprocess.Popen(command, stdout=out, stderr=out, text=True)


def finished(processes):
    return [(*process.communicate(timeout=300), process.returncode) for process in processes]


def pair(*flags):
    """Start both processes of a run, which meet on the loopback device."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{free.getsockname()[1]}"
    both = "--coordinator", where, "--num-processes", 2
    return [begun(*both, "--process-id", i, *flags) for i in range(2)]


@pytest.fixture(scope="module")
def two_processes(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("hosts") / "whole"
    (out, err, code), (other_out, other_err, other) = finished(pair(*FLAGS, "--run-dir", run_dir))
    assert (code, other) == (0, 0), err + other_err
    assert f"files in {run_dir}" in out
    assert "dgae_jax" not in other_out
    return run_dir


@pytest.fixture(scope="module")
def two_devices(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("devices") / "whole"
    ((_, err, code),) = finished([begun(*FLAGS, "--devices", 2, "--run-dir", run_dir)])
    assert code == 0, err
    assert json.loads((run_dir / "manifest.json").read_text())["options"]["devices"] == 2
    return run_dir


def arrays(run_dir):
    state, _ = checkpoint.latest_train_state(run_dir, directory.read_config(run_dir))
    return checkpoint.arrays_of(state)


@pytest.mark.slow
def test_two_processes_compute_what_two_devices_do(two_processes, two_devices):
    ours, theirs = arrays(two_processes), arrays(two_devices)
    for name, x in theirs.items():
        np.testing.assert_allclose(ours[name], x, atol=1e-5, err_msg=name)
    texts = [(d / "evaluation.json").read_text() for d in (two_processes, two_devices)]
    np.testing.assert_allclose(*(json.loads(text)["returns"] for text in texts), rtol=1e-5)


@pytest.mark.slow
def test_two_processes_resume_bit_for_bit(two_processes, tmp_path):
    half = tmp_path / "half"
    stopped_half_way(two_processes, half)
    for _, err, code in finished(pair("--resume", half, *CACHE)):
        assert code == 0, err
    assert_same(half, two_processes)


@pytest.mark.slow
def test_two_devices_resume_bit_for_bit_and_one_is_refused(two_devices, tmp_path):
    half = tmp_path / "half"
    stopped_half_way(two_devices, half)
    ((_, err, code),) = finished([begun("--resume", half, "--devices", "1", *CACHE)])
    assert code == 2
    assert "not bit-identical (devices 1 (was 2)" in err
    ((_, err, code),) = finished([begun("--resume", half, *CACHE)])
    assert code == 0, err
    assert_same(half, two_devices)


@pytest.mark.slow
def test_signal_to_any_process_stops_all_with_one_checkpoint(tmp_path):
    run_dir = tmp_path / "run"
    processes = pair(*TINY, "--total-steps", "100_000_000", "--run-dir", run_dir)
    rows = run_dir / "metrics.jsonl"
    while not rows.exists() or not rows.stat().st_size:
        time.sleep(0.2)
        assert all(process.poll() is None for process in processes), finished(processes)
    processes[1].send_signal(signal.SIGTERM)
    (out, _, code), (_, _, other) = finished(processes)
    assert (code, other) == (143, 143)
    assert f"stopped by SIGTERM; continue with --resume {run_dir}" in out
    (saved,) = (run_dir / "checkpoints").iterdir()
    assert saved.name == f"steps_{timeless(run_dir)[-1]['steps']:012d}.msgpack"


def test_uneven_number_of_devices_is_refused(tmp_path):
    run_dir = tmp_path / "run"
    ((_, err, code),) = finished([begun(*TINY, "--devices", 3, "--run-dir", run_dir)])
    assert code == 2
    assert "devices 3: must be a number that divides" in err
    assert not run_dir.exists()


@pytest.mark.parametrize(
    "given", [{"num_processes": 2}, {"process_id": 0}, {"coordinator": "localhost:1"}]
)
def test_incomplete_process_options_are_refused(given):
    with pytest.raises(ConfigError, match=r"^coordinator .*: must be HOST:PORT where"):
        runtime.join_processes(RunOptions(**given))


@pytest.mark.parametrize(
    ("environment", "several"),
    [
        ({"SLURM_NTASKS": "1"}, False),
        ({"SLURM_NTASKS": "2"}, True),
        ({"OMPI_COMM_WORLD_SIZE": "4"}, True),
        ({"TPU_WORKER_HOSTNAMES": "one,two"}, True),
        ({"KUBERNETES_SERVICE_HOST": "here"}, False),
        ({"KUBERNETES_SERVICE_HOST": "here", "JOB_COMPLETION_INDEX": "0"}, True),
    ],
)
def test_processes_of_a_scheduler_are_joined(environment, several, monkeypatch):
    monkeypatch.setattr(os, "environ", environment)
    met = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *where: met.append(where))
    runtime.join_processes(RunOptions())
    assert met == ([(None, None, None)] if several else [])
    runtime.join_processes(RunOptions(num_processes=1))
    assert len(met) == several


def test_missing_device_says_what_to_install(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", Mock(side_effect=AssertionError))
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    message = r"^JAX_PLATFORMS=cuda: must .* \(AssertionError\); .*dgae_jax\[cuda13\]"
    with pytest.raises(ConfigError, match=message):
        runtime.use_devices(SMALL, RunOptions())


def test_signal_during_import_stops_the_work_afterwards(monkeypatch, tmp_path, capfd):
    program = "import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\nwhole = True\n"
    (tmp_path / "signalled.py").write_text(program)
    monkeypatch.syspath_prepend(tmp_path)
    told = []
    with Signals() as signals:
        watch = signals.watching(told.append)
        watch("before")
        assert importlib.import_module("signalled").whole
        with pytest.raises(Stopped):
            watch("after")
        handlers = [signal.getsignal(kind) for kind in (signal.SIGTERM, signal.SIGHUP)]
        assert handlers == [signal.SIG_DFL, signal.SIG_IGN]  # a terminal may send several
    assert (told, signals.received) == (["before"], signal.SIGTERM)
    assert capfd.readouterr().err.startswith("SIGTERM: stopping; a second signal ends")


def test_nohup_is_respected():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with Signals() as signals:
        os.kill(os.getpid(), signal.SIGHUP)
    assert (signals.received, signal.getsignal(signal.SIGHUP)) == (None, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, before)


def start(run_dir):
    """Start or resume a run of 40 iterations with a checkpoint after each fifth."""
    flags = ["--run-dir", run_dir, "--total-steps", 40 * 64, "--checkpoint-every", 5 * 64]
    return begun("--resume-or-start", *flags, "--episodes", 1, *TINY, out=subprocess.DEVNULL)


@pytest.mark.slow
def test_kills_at_random_moments_lose_nothing(tmp_path):
    whole, killed, chance = tmp_path / "whole", tmp_path / "killed", random.Random(0)
    assert start(whole).wait() == 0
    since = time.monotonic()
    assert start(tmp_path / "again").wait() == 0  # with the compiled programs of the first
    usual = time.monotonic() - since
    kills = 0
    while kills < 25:
        process = start(killed)
        time.sleep(chance.uniform(0.3, 1.05) * usual)
        if process.poll() is None:
            process.kill()
            kills += 1
        process.wait()
        if (killed / "evaluation.json").exists():  # it got through: the next begins again
            assert last(killed).read_bytes() == last(whole).read_bytes()
            shutil.rmtree(killed)
    assert start(killed).wait() == 0
    assert_same(killed, whole)


@each_signal
def test_signal_breaks_off_compilation(kind, code, tmp_path):
    layers = [8] * 16  # several seconds of compilation
    run_dir, hidden = tmp_path / "run", ["--policy.hidden", *layers, "--critic.hidden", *layers]
    process = begun("--run-dir", run_dir, "--total-steps", 640, *TINY, *hidden)
    assert process.stdout.readline().startswith("hopper-v4")
    process.send_signal(kind)
    ((out, _, ended),) = finished([process])
    said = f"stopped by {kind.name}; continue with --resume {run_dir}\n"
    assert (ended, out) == (code, said)
    assert (run_dir / "metrics.jsonl").read_bytes() == b""
