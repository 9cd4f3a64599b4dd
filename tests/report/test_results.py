"""Rows are read strictly, and each refusal is one line."""

import json

import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.envs.registry import TASKS
from dgae_jax.report import results
from tests.report.rows import row, study


def refusal(path):
    with pytest.raises(ConfigError) as caught:
        results.read(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_row_is_what_the_file_says(tmp_path):
    curve = {"steps": [5, 10], "return": [None, 2.5]}
    final = {"engine": "gymnasium", "return_mean": 7, "returns": [9, 5]}
    written = row("hopper", "ppo", 3, curve=curve, final=final, seconds=9.5)
    read, other = results.read(study(tmp_path, [written, row(best=None)])).rows
    assert (read.run, read.task, read.algo, read.seed) == ("hopper-ppo-3", "hopper-v4", "ppo", 3)
    assert (read.seconds, read.final) == (9.5, 7.0)
    np.testing.assert_array_equal(read.curve_steps, [5, 10])
    np.testing.assert_array_equal(read.curve_returns, [np.nan, 2.5])
    assert (read.best, other.best) == (written["best"]["return_mean"], None)
    assert read.config | {"schema": 3} == written["config"]


def test_file_of_results_is_a_sweep_without_a_plan(tmp_path):
    directory = study(tmp_path / "one", [row()], planned=["hopper-dppo-1"])
    assert results.read(directory).missing == ("hopper-dppo-1",)
    alone = results.read(directory / "results.jsonl")
    assert (len(alone.rows), alone.missing, alone.name) == (1, (), "one")


def test_directory_that_is_no_sweep_is_refused(tmp_path):
    study(tmp_path / "planned", []).joinpath("results.jsonl").unlink()
    for path in (tmp_path / "none", tmp_path, tmp_path / "planned", study(tmp_path / "empty", [])):
        assert refusal(path).startswith(f"{path}: must be the directory of a sweep with results")


def test_rows_are_refused_by_their_number(tmp_path):
    refused = refusal(study(tmp_path, [row(), row()]))
    assert refused.endswith("line 2: run hopper-dppo-0, seed 0 is there twice")
    torn = json.dumps(row(seed=1))[:100]
    with (study(tmp_path, [row(seed=0)]) / "results.jsonl").open("a") as file:
        file.write(torn)
        file.flush()
        assert [each.seed for each in results.read(tmp_path).rows] == [0]  # still being written
        file.write("\n")
    assert refusal(tmp_path) == f"{tmp_path}/results.jsonl line 2: must be an object in JSON"


UNEVEN = "curve: must have increasing steps and a return for each"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"algo": "sac"}, "algo: must be one of ppo, dppo, trpo, dtrpo, a2c, da2c"),
        ({"seed": "1"}, "seed: must be int, not '1'"),
        ({"env_version": 4}, "env_version: must be str | None, not 4"),
        ({"seconds": None}, "seconds: must be float, not None"),
        ({"final": None}, "final.engine: must be str, not None"),
        ({"best": {"return_mean": "x"}}, "best.return_mean: must be float | None, not 'x'"),
        ({"curve": {"steps": [1, 2], "return": [1.0]}}, UNEVEN),
        ({"curve": {"steps": [2, 2], "return": [1.0, 2.0]}}, UNEVEN),
        ({"curve": {"steps": [1], "return": ["x"]}}, "curve.return: must be ndarray, not ['x']"),
        ({"config": {"schema": 99}}, "config: schema 99: must be one of 2, 3"),
    ],
)
def test_wrong_field_is_named_with_what_it_must_be(change, sentence, tmp_path):
    directory = study(tmp_path, [row() | change])
    assert refusal(directory) == f"{directory}/results.jsonl line 1: {sentence}"


def test_run_whose_return_is_not_finite_is_left_out_with_a_warning(tmp_path, capsys):
    diverged = row(seed=1, final={"engine": "jax", "return_mean": None, "returns": [None, 2.0]})
    found = results.read(study(tmp_path, [row(seed=0), diverged, row(seed=2)]))
    assert [each.seed for each in found.rows] == [0, 2]
    assert (found.diverged, found.missing) == ((("hopper-dppo-1", 1),), ())
    assert "line 2: left out: the return of hopper-dppo-1" in capsys.readouterr().err


def test_published_results_cover_every_task():
    rows = results.published()
    assert {one.task for one in rows} == set(TASKS)
    assert ("walker2d", 1_000_000, "TRPO", 4502.0, 234.0, 3, "SB3-contrib, v3") in rows
    assert ("swimmer", 4_000_000, "PPO", 282.0, None, None, "SLM-Lab") in rows
