"""Runs that stopped go on as if they had not."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import directory, files, metrics, training
from dgae_jax.run.options import RunOptions
from dgae_jax.run.training import train_command
from tests.runs import QUIET, SMALL, last, small, stopped_half_way, timeless


@pytest.mark.parametrize(
    ("algo", "physics", "seeds"),
    [
        ("dtrpo", "native", 1),
        ("a2c", "native", 3),
        *(
            pytest.param(algo, "native", 1, marks=pytest.mark.slow)
            for algo in ("ppo", "dppo", "trpo", "a2c", "da2c")
        ),
        pytest.param("dppo", "jax", 1, marks=pytest.mark.slow),
    ],
)
def test_a_run_that_stopped_half_way_ends_with_the_same_bits_and_the_same_metrics(
    algo, physics, seeds, tmp_path
):
    whole, half, config = tmp_path / "whole", tmp_path / "half", small(algo, physics, seeds)
    assert train_command(config, dataclasses.replace(QUIET, run_dir=whole)) == 0
    stopped_half_way(whole, half)
    assert train_command(config, dataclasses.replace(QUIET, resume=half)) == 0
    assert last(half).read_bytes() == last(whole).read_bytes()
    assert timeless(half) == timeless(whole)
    for name in ("evaluation.json", "evaluations.jsonl"):
        assert (half / name).read_bytes() == (whole / name).read_bytes()
    assert len(metrics.read(whole / "evaluations.jsonl")) == 2 * seeds


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gamma": 0.5}, "gamma 0.5: must be 0.99 as in"),
        ({"env": "ant"}, "env ant: must be hopper as in"),
        ({"algo": "a2c"}, "algo a2c: must be ppo as in"),
        ({"physics": "jax"}, "physics jax: must be native as in"),
        (
            {"policy": dataclasses.replace(SMALL.policy, clip_eps=0.3)},
            r"policy\.clip 0\.3: must be 0\.2 as in",
        ),
    ],
)
def test_a_changed_setting_is_refused_with_both_values(change, message, finished):
    with pytest.raises(ConfigError, match=message):
        train_command(
            dataclasses.replace(small(), **change), dataclasses.replace(QUIET, resume=finished)
        )


def test_a_finished_run_may_be_given_a_larger_budget(finished, tmp_path):
    longer = tmp_path / "longer"
    shutil.copytree(finished, longer)
    config = dataclasses.replace(small(), total_steps=10 * SMALL.samples_per_iteration)
    assert train_command(config, dataclasses.replace(QUIET, resume=longer)) == 0
    assert [row["iteration"] for row in metrics.read(longer / "metrics.jsonl")] == list(
        range(1, 11)
    )
    assert directory.read_config(longer).total_steps == config.total_steps


def test_a_budget_below_what_is_done_is_refused(finished):
    config = dataclasses.replace(small(), total_steps=7 * 64)
    with pytest.raises(
        ConfigError, match="total_steps 448: must be at least the 512 that are done"
    ):
        train_command(config, dataclasses.replace(QUIET, resume=finished))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("cores",), 99),
        (("device",), "tpu: v9"),
        (("git_revision",), "abc"),
        (("versions", "jaxlib"), "0.0.1"),
        (("settings", "jax_enable_x64"), True),
    ],
)
def test_another_machine_or_version_is_refused_by_both_values_unless_asked_for_and_then_warned_of(
    path, value, run_dir, capsys
):
    written = json.loads((run_dir / "manifest.json").read_text())
    (written if len(path) == 1 else written[path[0]])[path[-1]] = value
    files.write_json(run_dir / "manifest.json", written)
    with pytest.raises(
        ConfigError,
        match=rf"must go on where it began, or with --inexact; now {path[-1]} .* \(was {value}\)",
    ):
        train_command(small(), dataclasses.replace(QUIET, resume=run_dir))
    assert train_command(small(), dataclasses.replace(QUIET, resume=run_dir, inexact=True)) == 0
    assert f"(was {value}): rounding differs, by up to 1e-6 relative" in capsys.readouterr().err
    assert (
        train_command(small(), dataclasses.replace(QUIET, resume=run_dir)) == 0
    )  # where it was last


@pytest.mark.slow
def test_physics_may_change_if_asked_for_with_a_warning_that_names_the_tolerance(run_dir, capsys):
    other = dataclasses.replace(small("ppo", "jax"), total_steps=9 * 64)
    assert train_command(other, dataclasses.replace(QUIET, resume=run_dir, inexact=True)) == 0
    assert (
        "warning: physics jax (was native): one step differs by up to 1e-4"
        in capsys.readouterr().err
    )
    assert directory.read_config(run_dir).physics == "jax"


def test_a_run_that_lost_its_checkpoints_is_refused_and_keeps_the_rest(run_dir):
    shutil.rmtree(run_dir / "checkpoints")
    before = timeless(run_dir)
    with pytest.raises(
        ConfigError, match=r"must hold a checkpoint; it had some when it was evaluated"
    ):
        train_command(small(), dataclasses.replace(QUIET, resume=run_dir))
    assert timeless(run_dir) == before


def test_a_run_that_is_refused_for_its_metrics_is_left_as_it_was(run_dir):
    rows = (run_dir / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run_dir / "metrics.jsonl").write_text("".join(rows[:3]))
    before = {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}
    with pytest.raises(ConfigError, match="must hold the 8 iterations"):
        train_command(
            dataclasses.replace(small(), total_steps=9999),
            dataclasses.replace(QUIET, resume=run_dir),
        )
    assert {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()} == before


def test_a_resumed_run_goes_on_with_its_options(run_dir):
    assert directory.saved_options(run_dir) == RunOptions(
        checkpoint_every=256, episodes=1, devices=1
    )
    directory.extend_manifest(
        run_dir, RunOptions(keep_checkpoints=7, eval_engine="native", debug_nonfinite=True)
    )
    assert directory.saved_options(run_dir) == RunOptions(
        keep_checkpoints=7, eval_engine="native", debug_nonfinite=True
    )


def test_resume_or_start_starts_a_run_and_then_goes_on_with_it(finished, tmp_path):
    run_dir = tmp_path / "run"
    options = dataclasses.replace(QUIET, run_dir=run_dir, resume_or_start=True)
    assert train_command(small(), options) == 0
    assert timeless(run_dir) == timeless(finished)
    last(run_dir).unlink()
    assert train_command(small(), options) == 0
    assert last(run_dir).read_bytes() == last(finished).read_bytes()
    assert timeless(run_dir) == timeless(finished)
    with pytest.raises(ConfigError, match=r"gamma 0\.5: must be 0\.99 as in"):
        train_command(dataclasses.replace(small(), gamma=0.5), options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"resume_or_start": True},
            "resume_or_start True: must be used with the directory to look in, --run-dir DIR",
        ),
        (
            {"resume_or_start": True, "resume": Path("x")},
            "resume_or_start True: must be left out: --resume only resumes",
        ),
    ],
)
def test_resume_or_start_needs_a_directory_and_no_other_way_to_resume(options, message):
    with pytest.raises(ConfigError, match=message):
        train_command(small(), dataclasses.replace(QUIET, **options))


def test_who_heeds_the_evaluations_may_end_a_run_which_then_goes_on_as_if_it_had_not(
    finished, tmp_path
):
    run_dir, heard = tmp_path / "run", []

    def heed(steps, result):
        heard.append((steps, result["episodes"]))
        raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        training.train(small(), dataclasses.replace(QUIET, run_dir=run_dir), heed)
    assert heard == [(QUIET.checkpoint_every, 1)]
    assert not (run_dir / "evaluation.json").exists()
    training.train(
        small(), dataclasses.replace(QUIET, resume=run_dir), heed
    )  # what was evaluated before is not heard of again
    assert len(heard) == 1
    assert last(run_dir).read_bytes() == last(finished).read_bytes()
    assert timeless(run_dir) == timeless(finished)
