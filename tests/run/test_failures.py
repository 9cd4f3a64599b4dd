"""Runs that end early, and continue."""

import contextlib
import resource
import shutil
import signal

import jax
import numpy as np
import pytest

from dgae_jax.configs.resolved import resolve
from dgae_jax.run import checkpoint, directory, logger, metrics, training
from dgae_jax.run.logger import RunLogger
from dgae_jax.run.options import RunOptions
from tests.runs import SMALL, assert_same, each_signal, exit_code, last, small


def resumed_as(finished, run_dir):
    """Resume a run and compare it with one that never stopped."""
    assert exit_code(small(), resume=run_dir) == 0
    assert_same(run_dir, finished)


@pytest.mark.parametrize("evaluation", [1, 2])
@each_signal
def test_signal_breaks_off_evaluation(kind, code, evaluation, finished, tmp_path, monkeypatch):
    run_dir, calls = tmp_path / "run", []
    honest = logger.evaluate_policies

    def interrupted(*args, **how):
        calls.append(how)
        if len(calls) == evaluation:
            signal.raise_signal(kind)
        return honest(*args, **how)

    monkeypatch.setattr(logger, "evaluate_policies", interrupted)
    assert exit_code(small(), run_dir=run_dir) == code
    assert not (run_dir / "evaluation.json").exists()
    resumed_as(finished, run_dir)


def test_vanished_directory_ends_run_in_one_line(tmp_path, capsys, monkeypatch):
    run_dir, honest = tmp_path / "run", RunLogger.append

    def append(self, *args):
        shutil.rmtree(run_dir, ignore_errors=True)
        return honest(self, *args)

    monkeypatch.setattr(RunLogger, "append", append)
    assert exit_code(small(), run_dir=run_dir) == 1
    why = f"{run_dir}/metrics.jsonl: cannot be written (No such file or directory)"
    assert capsys.readouterr().err == f"stopped: {why}; there is no checkpoint\n"


@contextlib.contextmanager
def no_file_larger_than(size):
    """Make the operating system refuse to write more, as on a full disk."""
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, usual[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, usual)


def test_full_disk_ends_run_that_can_resume(finished, tmp_path, capsys):
    run_dir, size = tmp_path / "run", last(finished).stat().st_size
    assert 1.1 * size < (finished / "curve.png").stat().st_size
    with no_file_larger_than(int(1.1 * size)):
        assert exit_code(small(), run_dir=run_dir) == 1
    why = f"{run_dir}/curve.png: cannot be written (File too large)"
    left = f"continue from {last(run_dir).name} with --resume {run_dir}"
    assert capsys.readouterr().err == f"stopped: {why}; {left}\n"
    assert not list(run_dir.rglob("*.part"))
    resumed_as(finished, run_dir)


def test_nonfinite_updates_are_skipped_counted_and_end_run(tmp_path, capsys):
    run_dir = tmp_path / "run"
    changes = {"policy.learning_rate": 1e30, "policy.max_grad_norm": 1e30}
    broken = resolve(small().as_config().replace(**changes))
    assert exit_code(broken, run_dir=run_dir, max_nonfinite=3) == 1
    assert "stopped: non-finite updates" in capsys.readouterr().err
    assert sum(row["skipped"] for row in metrics.read(run_dir / "metrics.jsonl")) >= 3
    state, _ = checkpoint.latest_train_state(run_dir, directory.read_config(run_dir))
    assert checkpoint.not_finite(checkpoint.arrays_of(state)) == []
    assert not (run_dir / "evaluation.json").exists()


def test_nonfinite_network_ends_run_unsaved_in_one_line(tmp_path, capsys, monkeypatch):
    run_dir, broken = tmp_path / "run", {"policy.params": np.array([np.nan])}
    monkeypatch.setattr(checkpoint, "arrays_of", lambda state: broken)
    assert exit_code(small(), run_dir=run_dir) == 1
    why = "policy.params is not finite after 256 samples, which is not saved"
    assert capsys.readouterr().err == f"stopped: {why}; there is no checkpoint\n"


def test_out_of_memory_ends_run_in_one_line(tmp_path, capsys, monkeypatch):
    run_dir = tmp_path / "run"
    reasons = iter(["INTERNAL: a bug", "RESOURCE_EXHAUSTED: Out of memory.\nmore"])

    def fails(*_, **__):
        raise jax.errors.JaxRuntimeError(next(reasons))

    monkeypatch.setattr(logger, "evaluate_policies", fails)
    with pytest.raises(jax.errors.JaxRuntimeError, match="a bug"):
        exit_code(small(), run_dir=run_dir)
    assert exit_code(small(), resume=run_dir) == 1
    why = "out of memory (RESOURCE_EXHAUSTED: Out of memory.)"
    left = f"continue from {last(run_dir).name} with --resume {run_dir}"
    assert capsys.readouterr().err == f"stopped: {why}; {left}\n"


def test_incident_can_be_replayed(state, tmp_path):
    (qpos, *rest), action = state.episodes.incident
    changes = {
        "incident": (
            type(state.episodes.incident[0])(qpos.at[0, 1, 2].set(9), *rest),
            action + 0.5,
        ),
        "nonfinite": state.episodes.nonfinite.at[0, 1].set(2),
    }
    broken = state._replace(episodes=state.episodes._replace(**changes))
    run = RunLogger(tmp_path, SMALL, RunOptions(debug_nonfinite=True), 0)
    row = {"episode_return": np.zeros((2, 1)), "nonfinite": np.array([[0.0], [2.0]])}
    run.append(broken, row, 1)
    assert not (tmp_path / "nonfinite").exists()
    run.append(broken, jax.tree.map(lambda x: x[1:], row), 1)
    incident = np.load(tmp_path / "nonfinite" / "steps_000000000128_seed_0.npz")
    np.testing.assert_array_equal(incident["env"], [1])
    np.testing.assert_array_equal(incident["action"], 0.5)
    env = training.make_task(SMALL)
    at = incident["qpos"][0], incident["qvel"][0]
    assert float(env.set_state(env.reset(jax.random.key(0)), *at).pipeline_state.qpos[2]) == 9
