"""Runs that stopped continue bit for bit."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.run import directory, files, metrics, training
from dgae_jax.run.options import RunOptions
from dgae_jax.run.training import train_command
from tests.runs import QUIET, SMALL, last, small, stopped_half_way, timeless


def resume(config, run_dir, **options):
    return train_command(config, dataclasses.replace(QUIET, resume=run_dir, **options))


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
def test_resumed_run_ends_with_same_bits(algo, physics, seeds, tmp_path):
    whole, half, config = tmp_path / "whole", tmp_path / "half", small(algo, physics, seeds)
    assert train_command(config, dataclasses.replace(QUIET, run_dir=whole)) == 0
    stopped_half_way(whole, half)
    assert resume(config, half) == 0
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
        ({"policy.clip_eps": 0.3}, r"policy\.clip_eps 0\.3: must be 0\.2 as in"),
        ({"total_steps": 7 * 64}, "total_steps 448: must be at least the 512 that are done"),
    ],
)
def test_changed_setting_is_refused(change, message, finished):
    config = small("a2c" if "algo" in change else "ppo").as_config().replace(**change)
    with pytest.raises(ConfigError, match=message):
        resume(resolve(config), finished)


def test_finished_run_continues_with_larger_budget(run_dir):
    config = dataclasses.replace(small(), total_steps=10 * SMALL.samples_per_iteration)
    assert resume(config, run_dir) == 0
    rows = metrics.read(run_dir / "metrics.jsonl")
    assert [row["iteration"] for row in rows] == list(range(1, 11))
    assert directory.read_config(run_dir).total_steps == config.total_steps


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
def test_other_machine_is_refused_unless_inexact(path, value, run_dir, capsys):
    written = json.loads((run_dir / "manifest.json").read_text())
    (written if len(path) == 1 else written[path[0]])[path[-1]] = value
    files.write_json(run_dir / "manifest.json", written)
    with pytest.raises(ConfigError, match=rf"--inexact; now {path[-1]} .* \(was {value}\)"):
        resume(small(), run_dir)
    assert resume(small(), run_dir, inexact=True) == 0
    assert f"(was {value}): rounding differs, by up to 1e-6 relative" in capsys.readouterr().err
    assert resume(small(), run_dir) == 0  # where it was last


@pytest.mark.slow
def test_physics_may_change_if_inexact(run_dir, capsys):
    other = dataclasses.replace(small("ppo", "jax"), total_steps=9 * 64)
    assert resume(other, run_dir, inexact=True) == 0
    assert "warning: physics jax (was native): one step differs by" in capsys.readouterr().err
    assert directory.read_config(run_dir).physics == "jax"


def test_run_without_its_checkpoints_is_refused(run_dir):
    shutil.rmtree(run_dir / "checkpoints")
    before = timeless(run_dir)
    with pytest.raises(ConfigError, match="must hold a checkpoint; it had some"):
        resume(small(), run_dir)
    assert timeless(run_dir) == before


def test_refused_run_is_left_as_it_was(run_dir):
    rows = (run_dir / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run_dir / "metrics.jsonl").write_text("".join(rows[:3]))
    before = {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}
    with pytest.raises(ConfigError, match="must hold the 8 iterations"):
        resume(dataclasses.replace(small(), total_steps=9999), run_dir)
    assert {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()} == before


def test_resumed_run_keeps_its_options(run_dir):
    kept = {"episodes": 1, "checkpoint_every": QUIET.checkpoint_every, "devices": 1}
    assert directory.saved_options(run_dir) == RunOptions(**kept)
    directory.extend_manifest(run_dir, RunOptions(episodes=7, log=["tensorboard"]))
    assert directory.saved_options(run_dir) == RunOptions(episodes=7, log=("tensorboard",))
    text = (run_dir / "manifest.json").read_text()
    (run_dir / "manifest.json").write_text(text.replace('"tensorboard"', '{"no": "logger"}'))
    assert directory.saved_options(run_dir).log == ()


def test_resume_or_start_does_either(tmp_path, finished):
    options = dataclasses.replace(QUIET, run_dir=tmp_path / "run", resume_or_start=True)
    half = dataclasses.replace(small(), total_steps=4 * 64)
    for config in (half, small()):
        assert train_command(config, options) == 0
    assert len(timeless(tmp_path / "run")) == len(timeless(finished))
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert len(manifest["resumed"]) == 1
    with pytest.raises(ConfigError, match=r"gamma 0\.5: must be 0\.99 as in"):
        train_command(dataclasses.replace(small(), gamma=0.5), options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resume_or_start": True}, "resume_or_start True: must be used with --run-dir DIR"),
        (
            {"resume_or_start": True, "resume": Path("x")},
            "resume_or_start True: must be left out: --resume only resumes",
        ),
    ],
)
def test_resume_or_start_needs_a_directory(options, message):
    with pytest.raises(ConfigError, match=message):
        train_command(small(), dataclasses.replace(QUIET, **options))


def test_eval_callback_may_end_a_run(finished, tmp_path):
    run_dir, heard = tmp_path / "run", []

    def on_eval(steps, result):
        heard.append((steps, result["episodes"]))
        raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        training.train(small(), dataclasses.replace(QUIET, run_dir=run_dir), on_eval)
    assert heard == [(QUIET.checkpoint_every, 1)]
    assert not (run_dir / "evaluation.json").exists()
    training.train(small(), dataclasses.replace(QUIET, resume=run_dir), on_eval)
    assert len(heard) == 1  # what was evaluated before is not reported again
    assert last(run_dir).read_bytes() == last(finished).read_bytes()
    assert timeless(run_dir) == timeless(finished)
