"""What came of the cells, and how far they are."""

import dataclasses
import json
import os

import pytest

from dgae_jax.run import checkpoint
from dgae_jax.run.checkpoint import Networks
from dgae_jax.study import results, view
from dgae_jax.study.matrix import Cell, Study
from tests.runs import small


def test_configurations_that_differ_in_their_seeds_alone_have_the_same_digest():
    config = small()
    assert results.digest(dataclasses.replace(config, seed=7, num_seeds=3)) == results.digest(
        config
    )
    assert results.digest(dataclasses.replace(config, gamma=0.9)) != results.digest(config)


def test_a_curve_of_four_hundred_iterations_has_two_hundred_points_each_the_mean_of_two():
    rows = [
        {"steps": 10 * (i + 1), "episode_return": float(i) if i > 2 else None} for i in range(400)
    ]
    curve = results._curve(rows)
    assert curve["steps"][:3] == [20, 40, 60]
    assert curve["steps"][-1] == 4000
    assert curve["return"][:4] == [
        None,
        3.0,
        4.5,
        6.5,
    ]  # iterations 0-1, 2-3 of which 2 has none, 4-5, 6-7
    assert len(curve["return"]) == 200


def test_a_short_curve_has_every_iteration():
    rows = [{"steps": i + 1, "episode_return": 1.0} for i in range(3)]
    assert results._curve(rows) == {"steps": [1, 2, 3], "return": [1.0, 1.0, 1.0]}


@pytest.fixture
def study(tmp_path):
    cell = Cell("hopper-ppo-0", small())
    (tmp_path / "runs" / cell.name).mkdir(parents=True)
    return Study(tmp_path, (cell,), {})


def test_a_cell_that_is_trained_again_has_a_new_policy_and_one_that_was_not_keeps_its_file(
    study, monkeypatch
):
    monkeypatch.setattr(checkpoint, "load_networks", lambda *_: Networks(None, None, study.path))
    monkeypatch.setattr(checkpoint, "reward_std", lambda *_: None)
    monkeypatch.setattr(checkpoint, "save_networks", lambda path, *_: path.write_text("new"))
    run_dir, policy = study.run_dir(study.cells[0]), study.path / "policy.msgpack"
    (run_dir / "evaluation.json").write_text("{}")
    for age, content in ((-1, "new"), (1, "old")):
        policy.write_text("old")
        evaluated = (run_dir / "evaluation.json").stat().st_mtime
        os.utime(policy, (evaluated + age, evaluated + age))
        results._keep_policy(run_dir, study.cells[0].config, policy)
        assert policy.read_text() == content


def test_how_far_a_cell_is_is_read_from_its_last_whole_row_however_long_the_file(study):
    rows = [
        json.dumps({"steps": 64 * i, "episode_return": i, "more": "x" * 500}) for i in range(100)
    ]
    (study.run_dir(study.cells[0]) / "metrics.jsonl").write_text("\n".join(rows) + '\n{"steps": 64')
    assert view.reached(study, study.cells[0]) == (64 * 99, 99)


@pytest.mark.parametrize("content", [None, "", "torn", "[]\n"])
def test_a_cell_without_a_whole_row_is_at_its_beginning(study, content):
    if content is not None:
        (study.run_dir(study.cells[0]) / "metrics.jsonl").write_text(content)
    assert view.reached(study, study.cells[0]) == (0, None)
