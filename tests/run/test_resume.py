"""Runs that stopped continue bit for bit."""

import dataclasses
import json
import shutil

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.run import directory, files, metrics, training
from dgae_jax.run.options import RunOptions
from dgae_jax.run.training import train_command
from tests.runs import QUIET, last, small, stopped_half_way, timeless


def resume(config, run_dir, **options):
    return train_command(config, dataclasses.replace(QUIET, resume=run_dir, **options))


def assert_resumes_with_same_bits(whole, half):
    stopped_half_way(whole, half)
    config = directory.read_config(whole)
    assert resume(config, half) == 0
    assert last(half).read_bytes() == last(whole).read_bytes()
    assert timeless(half) == timeless(whole)
    for name in ("evaluation.json", "evaluations.jsonl"):
        assert (half / name).read_bytes() == (whole / name).read_bytes()
    assert len(metrics.read(whole / "evaluations.jsonl")) == 2 * config.num_seeds


@pytest.mark.parametrize("run", ["finished", "three_seeds"])
def test_resumed_run_ends_with_same_bits(run, request, tmp_path):
    assert_resumes_with_same_bits(request.getfixturevalue(run), tmp_path / "half")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "physics"),
    [
        *((algo, "native") for algo in ("dppo", "trpo", "dtrpo", "a2c", "da2c")),
        ("dppo", "jax"),
    ],
)
def test_every_algorithm_resumes_with_same_bits(algo, physics, tmp_path):
    whole = tmp_path / "whole"
    assert train_command(small(algo, physics), dataclasses.replace(QUIET, run_dir=whole)) == 0
    assert_resumes_with_same_bits(whole, tmp_path / "half")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gamma": 0.5}, "gamma 0.5: must be 0.99 as in"),
        ({"algo": "a2c"}, "algo a2c: must be ppo as in"),
        ({"physics": "jax"}, r"not bit-identical \(physics jax \(was native\)"),
        ({"total_steps": 7 * 64}, "total_steps 448: must be at least the 512 that are done"),
    ],
)
def test_changed_setting_is_refused(change, message, finished):
    config = small("a2c" if "algo" in change else "ppo").as_config().replace(**change)
    with pytest.raises(ConfigError, match=message):
        resume(resolve(config), finished)


@pytest.mark.parametrize("path", [("cores",), ("versions", "jaxlib")])
def test_other_machine_is_refused_unless_inexact(path, run_dir, capsys):
    written = json.loads((run_dir / "manifest.json").read_text())
    (written if len(path) == 1 else written[path[0]])[path[-1]] = 99
    files.write_json(run_dir / "manifest.json", written)
    with pytest.raises(ConfigError, match=rf"not bit-identical \({path[-1]} .* \(was 99\)"):
        resume(small(), run_dir)
    assert resume(small(), run_dir, inexact=True) == 0
    assert "(was 99): the run is not bit-identical from here on" in capsys.readouterr().err
    assert resume(small(), run_dir) == 0  # where it was last


@pytest.mark.slow
def test_physics_may_change_if_inexact(run_dir, capsys):
    other = dataclasses.replace(small("ppo", "jax"), total_steps=9 * 64)
    assert resume(other, run_dir, inexact=True) == 0
    assert "warning: physics jax (was native): the run is not" in capsys.readouterr().err
    assert directory.read_config(run_dir).physics == "jax"


def test_damaged_run_is_refused_and_left_as_it_was(run_dir):
    def refused(message):
        before = {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}
        with pytest.raises(ConfigError, match=message):
            resume(small(), run_dir)
        assert {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()} == before

    rows = (run_dir / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run_dir / "metrics.jsonl").write_text("".join(rows[:3]))
    refused("must hold the 8 iterations")
    shutil.rmtree(run_dir / "checkpoints")
    refused("must hold a checkpoint; it had some")


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
    with pytest.raises(ConfigError, match="resume_or_start True: must be used with --run-dir DIR"):
        train_command(small(), dataclasses.replace(options, run_dir=None))


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
