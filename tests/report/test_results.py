"""Rows are read strictly, and whatever is wrong is one line."""

import json

import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.report import page, results
from dgae_jax.report.groups import groups_of
from tests.report.rows import row, study


def refusal(path):
    with pytest.raises(ConfigError) as caught:
        results.read(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_row_is_what_the_file_says(tmp_path):
    curve = {"steps": [5, 10], "return": [None, 2.5]}
    written = row(
        "hopper",
        "ppo",
        3,
        curve=curve,
        final={"engine": "gymnasium", "return_mean": 7, "returns": [9, 5]},
        seconds=9.5,
    )
    (read,) = results.read(study(tmp_path, [written])).rows
    assert (read.cell, read.task, read.algo, read.seed, read.seconds) == (
        "hopper-ppo-3",
        "hopper-v4",
        "ppo",
        3,
        9.5,
    )
    assert (read.final, read.worst) == (7.0, 5.0)
    np.testing.assert_array_equal(read.curve_steps, [5, 10])
    np.testing.assert_array_equal(read.curve_returns, [np.nan, 2.5])
    assert (read.best, read.best_steps, read.config) == (
        written["best"]["return_mean"],
        800_000,
        written["config"],
    )


def test_a_run_without_evaluations_along_the_way_has_no_best(tmp_path):
    (read,) = results.read(study(tmp_path, [row(best=None)])).rows
    assert (read.best, read.best_steps) == (None, None)


def test_a_file_of_results_is_a_study_without_a_plan(tmp_path):
    directory = study(tmp_path / "one", [row()], planned=["hopper-dppo-1"])
    assert results.read(directory).missing == ["hopper-dppo-1"]
    alone = results.read(directory / "results.jsonl")
    assert (len(alone.rows), alone.missing, alone.name) == (1, [], "one")


def test_a_row_that_is_still_being_written_is_not_there_yet(tmp_path):
    directory = study(tmp_path, [row(seed=0)])
    with (directory / "results.jsonl").open("a") as file:
        file.write(json.dumps(row(seed=1))[:100])
    assert [each.seed for each in results.read(directory).rows] == [0]


def test_what_is_no_study_is_refused(tmp_path):
    assert (
        refusal(tmp_path / "none")
        == f"{tmp_path}/none: must be the directory of a study; there is nothing"
    )
    assert (
        refusal(tmp_path)
        == f"{tmp_path}: must be the directory of a study, with study.json and results.jsonl"
    )
    (tmp_path / "study.json").write_text('{"cells": {}}')
    assert refusal(tmp_path) == f"{tmp_path}: must have results; results.jsonl has none yet"
    (tmp_path / "results.jsonl").write_text("")
    assert refusal(tmp_path) == f"{tmp_path}: must have results; results.jsonl has none yet"
    study(tmp_path, [row()])
    (tmp_path / "study.json").write_text("[]")
    assert (
        refusal(tmp_path) == f"{tmp_path}/study.json: must be an object with the cells of the study"
    )


def test_a_line_that_is_no_row_is_refused_by_its_number(tmp_path):
    directory = study(tmp_path, [row(seed=0), row(seed=1)])
    lines = (directory / "results.jsonl").read_text().splitlines()
    (directory / "results.jsonl").write_text("\n".join([lines[0], "torn", lines[1], ""]))
    assert refusal(directory) == f"{directory}/results.jsonl line 2: must be an object in JSON"


def test_a_seed_that_is_there_twice_is_refused(tmp_path):
    assert refusal(study(tmp_path, [row(), row()])).endswith(
        "line 2: cell hopper-dppo-0, seed 0 is there twice"
    )


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"algo": "sac"}, "algo: must be one of ppo, dppo, trpo, dtrpo, a2c, da2c"),
        ({"algo": ["ppo"]}, "algo: must be one of ppo, dppo, trpo, dtrpo, a2c, da2c"),
        ({"seed": True}, "seed: must be a whole number"),
        ({"seed": 1.0}, "seed: must be a whole number"),
        ({"env_version": 4}, "env_version: must be a string or null"),
        ({"seconds": None}, "seconds: must be a number"),
        ({"final": None}, "final: must be an object"),
        ({"final": {"engine": "gymnasium"}}, "final.return_mean: missing"),
        (
            {"final": {"engine": "gymnasium", "return_mean": float("nan")}},
            "final.return_mean: must be a number",
        ),
        (
            {"final": {"engine": "gymnasium", "return_mean": 1, "returns": []}},
            "final.returns: must be a list of numbers, one at least",
        ),
        ({"best": {"steps": 5}}, "best.return_mean: missing"),
        ({"best": 3}, "best: must be an object or null"),
        (
            {"curve": {"steps": [1, 2], "return": [1.0]}},
            "curve: must have increasing steps and a return for each",
        ),
        (
            {"curve": {"steps": [2, 2], "return": [1.0, 2.0]}},
            "curve: must have increasing steps and a return for each",
        ),
        (
            {"curve": {"steps": [1], "return": ["x"]}},
            "curve.return: must be a list of numbers, null where there is none",
        ),
        ({"curve": {"steps": 1, "return": []}}, "curve.steps: must be a list of whole numbers"),
    ],
)
def test_a_field_that_is_wrong_is_named_with_what_it_must_be(change, sentence, tmp_path):
    assert (
        refusal(study(tmp_path, [row() | change])) == f"{tmp_path}/results.jsonl line 1: {sentence}"
    )


@pytest.mark.parametrize("name", [name for name in results.FIELDS if "." not in name])
def test_a_field_that_is_missing_is_named(name, tmp_path):
    data = row()
    study(tmp_path, [data])
    del data[name]
    (tmp_path / "results.jsonl").write_text(json.dumps(data) + "\n")
    assert refusal(tmp_path) == f"{tmp_path}/results.jsonl line 1: {name}: missing"


def test_a_run_whose_return_is_not_finite_has_no_result_and_that_is_said(tmp_path, capsys):
    diverged = row(seed=1, final={"engine": "jax", "return_mean": None, "returns": [None, 2.0]})
    directory = study(tmp_path, [row(seed=0), diverged, row(seed=2)])
    found = results.read(directory)
    assert [each.seed for each in found.rows] == [0, 2]
    assert (found.diverged, found.missing) == (((diverged["cell"], 1),), [])
    assert (
        f"results.jsonl line 2: left out, because the return of cell {diverged['cell']}, seed 1 is not finite"
        in capsys.readouterr().err
    )
    content = page.Content(found, groups_of(found.rows), [])
    assert (
        f"Left out, because their return is not finite: seed 1 of {diverged['cell']}."
        in page._summary(content)
    )


def test_a_line_that_is_no_row_behind_one_that_is_left_out_is_named_by_its_number(tmp_path):
    directory = study(
        tmp_path,
        [row(seed=0), row(seed=1, final={"engine": "jax", "return_mean": None, "returns": [None]})],
    )
    with (directory / "results.jsonl").open("a") as file:
        file.write("nonsense\n")
    assert refusal(directory).endswith("results.jsonl line 3: must be an object in JSON")
