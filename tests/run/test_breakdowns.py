"""What ends a run early, and what is left of it."""

import contextlib
import dataclasses
import re
import resource
import shutil
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dgae_jax.run import checkpoint, directory, logger, metrics, training
from dgae_jax.run.logger import RunLogger
from dgae_jax.run.training import train_command
from tests.runs import QUIET, SMALL, last, small, timeless


@pytest.mark.parametrize("evaluation", [1, 2])
@pytest.mark.parametrize(
    ("kind", "code"),
    [
        (signal.SIGTERM, 143),
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow),
    ],
)
def test_a_signal_in_an_evaluation_breaks_it_off_and_the_run_goes_on_later_to_the_same_end(
    kind, code, evaluation, finished, tmp_path, capsys
):
    run_dir, config, calls = tmp_path / "run", small(), []

    def interrupted(*args, **how):
        calls.append(how)
        if len(calls) == evaluation:
            signal.raise_signal(kind)
            honest(*args, **how)
            pytest.fail("the evaluation went on")
        return honest(*args, **how)

    honest = logger.evaluate_policies
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logger, "evaluate_policies", interrupted)
        assert train_command(config, dataclasses.replace(QUIET, run_dir=run_dir)) == code
    assert f"stopped by {kind.name}; continue with --resume {run_dir}" in capsys.readouterr().out
    assert len(calls) == evaluation
    assert not (run_dir / "evaluation.json").exists()
    assert train_command(config, dataclasses.replace(QUIET, resume=run_dir)) == 0
    assert last(run_dir).read_bytes() == last(finished).read_bytes()
    assert timeless(run_dir) == timeless(finished)
    assert (run_dir / "evaluations.jsonl").read_bytes() == (
        finished / "evaluations.jsonl"
    ).read_bytes()


def test_a_directory_that_vanishes_while_it_trains_ends_the_run_in_one_line(tmp_path, capsys):
    run_dir, honest = tmp_path / "run", RunLogger.append

    def append(record, *args):
        if record.steps == 64:  # no checkpoint yet, nothing on its way
            shutil.rmtree(run_dir)
        return honest(record, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunLogger, "append", append)
        assert train_command(small(), dataclasses.replace(QUIET, run_dir=run_dir)) == 1
    error = f"stopped: {run_dir}/metrics.jsonl: cannot be written (No such file or directory); there is no checkpoint\n"
    assert capsys.readouterr().err == error
    assert not run_dir.exists()


@contextlib.contextmanager
def no_file_larger_than(size):
    """The operating system refuses to write more, as on a full disk."""
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


@pytest.mark.parametrize(
    ("name", "share"), [("checkpoints/steps_000000000256.msgpack", 0.9), ("curve.png", 1.1)]
)
def test_a_disk_that_takes_no_more_ends_the_run_in_one_line_and_it_goes_on_later_to_the_same_end(
    name, share, finished, tmp_path, capsys
):
    run_dir, size = tmp_path / "run", last(finished).stat().st_size
    assert (
        (finished / "metrics.jsonl").stat().st_size
        < 0.9 * size
        < 1.1 * size
        < (finished / "curve.png").stat().st_size
    )
    with no_file_larger_than(int(share * size)):
        assert train_command(small(), dataclasses.replace(QUIET, run_dir=run_dir)) == 1
    left = (
        f"continue from {last(run_dir).name} with --resume {run_dir}"
        if share > 1
        else "there is no checkpoint"
    )
    assert (
        capsys.readouterr().err
        == f"stopped: {run_dir}/{name}: cannot be written (File too large); {left}\n"
    )
    assert not list(run_dir.rglob("*.part"))
    assert train_command(small(), dataclasses.replace(QUIET, resume=run_dir)) == 0
    assert last(run_dir).read_bytes() == last(finished).read_bytes()
    assert timeless(run_dir) == timeless(finished)


def test_updates_that_are_not_finite_are_left_out_and_counted_and_end_the_run_when_there_is_no_other(
    tmp_path, capsys
):
    broken = dataclasses.replace(
        small(), policy=dataclasses.replace(SMALL.policy, learning_rate=1e30, max_grad_norm=1e30)
    )
    options = dataclasses.replace(QUIET, run_dir=tmp_path / "run", max_nonfinite=3)
    assert train_command(broken, options) == 1
    assert "updates were not finite and were left out" in capsys.readouterr().err
    rows = metrics.read(tmp_path / "run" / "metrics.jsonl")
    assert sum(row["skipped"] for row in rows) >= 3
    state, _ = checkpoint.latest_train_state(
        tmp_path / "run", directory.read_config(tmp_path / "run")
    )
    assert all(
        jnp.isfinite(x).all()
        for fit in (state.policy, state.critic)
        for x in fit.params["params"]["Dense_0"].values()
    )
    assert not (tmp_path / "run" / "evaluation.json").exists()


def test_failures_in_a_row_are_seen_also_where_a_success_followed_before_anybody_looked():
    skipped, nonfinite = (
        np.array([[1, 0], [1, 0], [0, 0], [1, 0], [9, 9]]),
        np.array([[0, 0], [0, 33], [32, 33], [0, 0], [9, 9]]),
    )
    rows = training._failures(np.array([2, 0]), {"skipped": skipped, "nonfinite": nonfinite}, 4, 64)
    assert rows.tolist() == [
        [3, 0],
        [4, 1],
        [0, 2],
        [1, 0],
    ]  # half of the 64 steps is not most of them


@pytest.mark.parametrize(
    "reason",
    [MemoryError(), jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory.\nmore")],
)
def test_an_allocation_that_fails_later_is_one_line_that_names_the_checkpoint_and_nothing_is_lost(
    reason, finished, tmp_path, capsys
):
    run_dir, honest = tmp_path / "run", training.make_trainer
    counts = iter(range(99))

    def exhausted(*args):
        trainer = honest(*args)

        def dispatch(*args):
            if next(counts) == 2:
                raise reason
            return trainer.dispatch(*args)

        dispatch.lower = trainer.dispatch.lower
        return trainer._replace(dispatch=dispatch)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "make_trainer", exhausted)
        assert train_command(small(), dataclasses.replace(QUIET, run_dir=run_dir)) == 1
    why = str(reason).partition("\n")[0] or "MemoryError"
    left = f"continue from {last(run_dir).name} with --resume {run_dir}"
    assert capsys.readouterr().err == f"stopped: out of memory ({why}); {left}\n"
    assert last(run_dir).name == f"steps_{timeless(run_dir)[-1]['steps']:012d}.msgpack"
    assert train_command(small(), dataclasses.replace(QUIET, resume=run_dir)) == 0
    assert last(run_dir).read_bytes() == last(finished).read_bytes()
    assert timeless(run_dir) == timeless(finished)


def test_an_error_that_is_none_of_memory_stays_what_it_is(tmp_path):
    def fails(*_, **__):
        raise jax.errors.JaxRuntimeError("INTERNAL: a bug")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logger, "evaluate_policies", fails)
        with pytest.raises(jax.errors.JaxRuntimeError, match="a bug"):
            train_command(small(), dataclasses.replace(QUIET, run_dir=tmp_path / "run"))


def test_a_state_that_is_not_finite_ends_the_run_in_one_line_and_is_not_saved(tmp_path, capsys):
    run_dir, honest = tmp_path / "run", RunLogger.save

    def save(record, state):
        if record.steps == 512:
            state = state._replace(
                observations=jax.tree.map(lambda x: x * jnp.nan, state.observations)
            )
        honest(record, state)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunLogger, "save", save)
        assert train_command(small(), dataclasses.replace(QUIET, run_dir=run_dir)) == 1
    assert re.fullmatch(
        rf"stopped: observations\.\S+ is not finite after 512 samples, which is not saved; continue from steps_000000000256.msgpack"
        rf" with --resume {run_dir}\n",
        capsys.readouterr().err,
    )
    assert last(run_dir).name == "steps_000000000256.msgpack"
