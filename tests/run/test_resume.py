"""Runs that stopped continue bit for bit."""

import dataclasses
import json
import shutil

import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.run import directory, files, metrics, training
from dgae_jax.run.options import RunOptions
from tests.runs import QUIET, assert_same, exit_code, small, stopped_half_way


def assert_resumes_with_same_bits(whole, half):
    stopped_half_way(whole, half)
    config = directory.read_config(whole)
    assert exit_code(config, resume=half) == 0
    assert_same(half, whole)
    assert (half / "evaluation.json").read_bytes() == (whole / "evaluation.json").read_bytes()
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
    assert exit_code(small(algo, physics), run_dir=whole) == 0
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
        exit_code(resolve(config), resume=finished)


@pytest.mark.parametrize("path", [("cores",), ("versions", "jaxlib")])
def test_other_machine_is_refused_unless_inexact(path, run_dir, capsys):
    written = json.loads((run_dir / "manifest.json").read_text())
    (written if len(path) == 1 else written[path[0]])[path[-1]] = 99
    files.write_json(run_dir / "manifest.json", written)
    with pytest.raises(ConfigError, match=rf"not bit-identical \({path[-1]} .* \(was 99\)"):
        exit_code(small(), resume=run_dir)
    assert exit_code(small(), resume=run_dir, inexact=True) == 0
    assert "(was 99): the run is not bit-identical from here on" in capsys.readouterr().err
    assert exit_code(small(), resume=run_dir) == 0  # where it was last


@pytest.mark.slow
def test_physics_may_change_if_inexact(run_dir, capsys):
    other = dataclasses.replace(small("ppo", "jax"), total_steps=9 * 64)
    assert exit_code(other, resume=run_dir, inexact=True) == 0
    assert "warning: physics jax (was native): the run is not" in capsys.readouterr().err
    assert directory.read_config(run_dir).physics == "jax"


def test_damaged_run_is_refused_and_left_as_it_was(run_dir):
    def refused(message):
        before = {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}
        with pytest.raises(ConfigError, match=message):
            exit_code(small(), resume=run_dir)
        assert {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()} == before

    rows = (run_dir / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run_dir / "metrics.jsonl").write_text("".join(rows[:3]))
    refused("must hold the 8 iterations")
    shutil.rmtree(run_dir / "checkpoints")
    refused("must hold a checkpoint; it had some")


def test_resumed_run_keeps_its_options(run_dir):
    kept = {"episodes": 1, "checkpoint_every": QUIET.checkpoint_every, "devices": 1}
    assert directory.saved_options(run_dir) == RunOptions(**kept)
    directory.continue_run(run_dir, small(), RunOptions(episodes=7, log=["tensorboard"]))
    assert directory.saved_options(run_dir) == RunOptions(episodes=7, log=("tensorboard",))


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
    assert_same(run_dir, finished)
