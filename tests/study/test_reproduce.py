"""The course of a sweep: real processes, real runs."""

import contextlib
import json
import os
import shutil
import signal
import time
from concurrent.futures import Future

import numpy as np
import pytest

import dgae_jax as dg
from dgae_jax.configs.serial import digest
from dgae_jax.run import directory, metrics
from dgae_jax.run.evaluation import evaluate_run
from dgae_jax.run.options import RunOptions
from dgae_jax.study import sweep as sweeps
from dgae_jax.study.reproduce import reached, reproduce
from tests import studies
from tests.runs import last

NAMES = ["hopper-ppo-0", "hopper-ppo-1"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A sweep of two runs that was not disturbed, and what it printed."""
    path = tmp_path_factory.mktemp("sweeps") / "whole"
    return path, studies.succeed(studies.start(path))


@pytest.fixture
def copy(whole, tmp_path):
    """A copy of that sweep."""
    shutil.copytree(whole[0], tmp_path / "sweep")
    return tmp_path / "sweep"


@contextlib.contextmanager
def no_launch(jobs):
    """Launch nothing: every run fails at once."""
    tasks = {}
    for job in jobs:
        tasks[task := Future()] = job
        task.set_exception(RuntimeError("no machine"))
    yield tasks


def again(path):
    """Reproduce a sweep in this process, without training; return the exit code."""
    runs = sweeps.read(path).runs
    with sweeps.opened(path, runs, "") as sweep:
        return reproduce(sweep, runs, RunOptions(), no_launch)


def test_a_sweep_ends_with_a_row_per_run(whole):
    path, lines = whole
    assert lines[0] == f"{path}: 0 of 2 runs are done, 2 to train"
    assert sorted(line.split(":")[0] for line in lines[1:] if "return" in line) == NAMES
    rows = metrics.read(path / "results.jsonl")
    assert [row["cell"] for row in rows] == NAMES
    for row in rows:
        run_dir = path / "runs" / row["cell"]
        final = json.loads((run_dir / "evaluation.json").read_text())
        trained = metrics.read(run_dir / "metrics.jsonl")
        assert row["final"]["returns"] == final["returns"]
        assert row["config"] == json.loads((run_dir / "config.json").read_text())
        assert row["hash"] == digest(directory.read_config(run_dir))
        assert (row["steps"], row["seconds"]) == (640, trained[-1]["seconds"])
        assert row["best"]["return_mean"] == max(row["evaluations"]["return_mean"])
        assert row["curve"]["steps"] == [each["steps"] for each in trained]
        assert row["command"].startswith("dgae reproduce ")


def test_the_policy_of_a_run_gives_its_returns_again(whole):
    path, _ = whole
    row = studies.rows(path)[0]
    file = path / row["policy"]
    found = evaluate_run(file, directory.config_of(file), which="latest", episodes=2)
    assert found["returns"] == row["final"]["returns"]
    assert dg.load_policy(file)(np.zeros(11)).shape == (3,)


@pytest.mark.parametrize("with_runs", [True, False])
def test_runs_that_are_done_are_skipped(copy, capsys, with_runs):
    before = (copy / "results.jsonl").read_bytes()
    if not with_runs:
        shutil.rmtree(copy / "runs")
    assert again(copy) == 0
    assert capsys.readouterr() == (f"{copy}: 2 of 2 runs are done\n", "")
    assert (copy / "results.jsonl").read_bytes() == before


def test_a_run_that_fails_is_named(copy, capsys):
    shutil.rmtree(copy / "runs" / NAMES[1])
    (copy / "results.jsonl").unlink()
    assert again(copy) == 1
    out, err = capsys.readouterr()
    assert f"{NAMES[1]}: RuntimeError: no machine" in out
    assert err.startswith(f"failed: {NAMES[1]}, see ")
    assert [row["cell"] for row in studies.rows(copy)] == NAMES[:1]


def test_a_run_that_is_trained_again_has_a_new_policy(copy):
    old, kept = (copy / "policies" / f"{name}.msgpack" for name in NAMES)
    content = old.read_bytes()
    for policy, age in ((old, -1), (kept, 1)):
        policy.write_text("old")
        ended = (copy / "runs" / policy.stem / "evaluation.json").stat().st_mtime
        os.utime(policy, (ended + age, ended + age))
    assert again(copy) == 0
    assert (old.read_bytes(), kept.read_text()) == (content, "old")


@pytest.mark.parametrize("end", ["", '{"steps": 64', "[]\n"])
def test_progress_is_read_from_the_last_whole_row(copy, end):
    sweep = sweeps.read(copy)
    file = copy / "runs" / NAMES[0] / "metrics.jsonl"
    rows = [{"steps": 64 * i, "episode_return": i, "more": "x" * 500} for i in range(100)]
    file.write_text("".join(json.dumps(row) + "\n" for row in rows) + end)
    assert reached(sweep, NAMES[0]) == (0 if end == "[]\n" else 64 * 99)
    file.unlink()
    assert reached(sweep, NAMES[0]) == 0


@pytest.mark.slow
def test_a_run_continues_from_its_checkpoint_on_another_machine_if_asked(whole, copy):
    torn = copy / "runs" / NAMES[0]
    last(torn).unlink()
    (torn / "evaluation.json").unlink()
    manifest = json.loads((torn / "manifest.json").read_text())
    (torn / "manifest.json").write_text(json.dumps({**manifest, "cores": 99}))
    code, lines, _ = studies.finish(studies.start(copy))
    assert code == 1
    assert any("ended with exit code 2: error: resume" in line for line in lines)
    studies.succeed(studies.start(copy, "--inexact"))
    log = (copy / "logs" / f"{NAMES[0]}.log").read_text()
    assert "warning: cores 1 (was 99)" in log
    assert "resuming from steps_000000000320.msgpack" in log
    assert studies.rows(copy)[1] == studies.rows(whole[0])[1]


@pytest.mark.slow
def test_a_signal_stops_all_runs_with_a_checkpoint(tmp_path):
    process = studies.start(tmp_path, steps=1_000_000)
    studies.wait_for(lambda: list(tmp_path.glob("runs/*/metrics.jsonl")))
    time.sleep(1)
    process.send_signal(signal.SIGTERM)
    code, lines, _ = studies.finish(process)
    assert code == 143
    assert lines[-1] == "stopped by SIGTERM; the same command continues"
    logs = [path.read_text() for path in tmp_path.glob("logs/*.log")]
    assert all("stopped by SIGTERM" in log for log in logs)


@pytest.fixture(scope="module")
def longer(tmp_path_factory):
    """The rows of a longer sweep; one run at a time has all cores, as on a cluster."""
    path = tmp_path_factory.mktemp("sweeps") / "longer"
    studies.succeed(studies.start(path, "--processes", "1", steps=400))
    return studies.rows(path)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Ray's
def test_a_run_whose_ray_node_dies_continues_on_another(longer, tmp_path):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        second = cluster.add_node(num_cpus=1)
        more = ["--launcher", "ray", "--address", cluster.address]
        process = studies.start(tmp_path, *more, steps=400)
        studies.wait_for(lambda: len(list(tmp_path.glob("runs/*/checkpoints/*"))) > 1)
        cluster.remove_node(second, allow_graceful=False)
        studies.succeed(process)
    finally:
        cluster.shutdown()
    assert studies.rows(tmp_path) == longer
    logs = [path.read_text() for path in tmp_path.glob("logs/*.log")]
    assert sum("resuming from steps_" in log for log in logs) == 1


@pytest.mark.slow
def test_submitit_runs_a_sweep(longer, tmp_path):
    pytest.importorskip("submitit")
    program = (
        "import shutil, submitit; from dgae_jax.cli.reproduce import reproduce\n"
        "Auto = submitit.AutoExecutor\n"
        "submitit.AutoExecutor = lambda folder, _: Auto(folder, 'local')\n"
        "shutil.which = lambda name, *_, **__: name; raise SystemExit(reproduce())"
    )
    more = ["--launcher", "slurm"]
    studies.succeed(studies.start(tmp_path, *more, steps=400, program=("-c", program)))
    assert studies.rows(tmp_path) == longer
