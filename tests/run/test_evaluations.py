"""The growing file of evaluations."""

import numpy as np
import pytest

from dgae_jax.run import files
from dgae_jax.run.metrics import EvaluationsFile

EVALUATIONS = [
    {"steps": steps, "seed": seed, "return_mean": mean, "return_std": 1.0}
    for steps, means in (
        (100, (1.0, 9.0)),
        (200, (6.0, 6.0)),
        (300, (2.0, 10.0)),
        (400, (5.0, 5.0)),
    )
    for seed, mean in enumerate(means)
]


def test_the_best_evaluation_is_the_one_with_the_highest_mean_over_seeds_and_of_equals_the_later(
    tmp_path,
):
    path = tmp_path / "evaluations.jsonl"
    assert EvaluationsFile(path).best is None
    files.append_rows(path, EVALUATIONS)
    assert EvaluationsFile(path).best == 300
    assert not EvaluationsFile(path).has(500)
    cut = EvaluationsFile(path)
    cut.cut(250, 2)
    assert EvaluationsFile(path).best == 200
    np.testing.assert_array_equal(
        EvaluationsFile(path).points(), [[100, 1, 1], [100, 9, 1], [200, 6, 1], [200, 6, 1]]
    )


def test_an_evaluation_that_lacks_a_seed_is_made_again(tmp_path):
    path = tmp_path / "evaluations.jsonl"
    files.append_rows(path, EVALUATIONS[:3])
    file = EvaluationsFile(path)
    assert file.has(200)
    file.cut(1000, 2)
    assert file.has(100)
    assert not file.has(200)


@pytest.mark.parametrize(
    "row",
    [
        {},
        {"steps": -1},
        {"steps": 2.5},
        {"steps": True},
        {"return_mean": "9"},
        {"return_mean": 1e400},
        {"return_std": -1},
    ],
)
def test_an_evaluation_that_is_none_is_passed_over(row, tmp_path):
    path = tmp_path / "evaluations.jsonl"
    files.append_rows(path, [EVALUATIONS[0], {**EVALUATIONS[1], **row} if row else {}])
    assert len(EvaluationsFile(path).rows) == 1


def test_an_evaluation_in_which_a_seed_diverged_is_not_the_best_before_a_resume_or_after_it(
    tmp_path,
):
    path = tmp_path / "evaluations.jsonl"
    files.append_rows(path, EVALUATIONS[:4])
    file = EvaluationsFile(path)
    seeds = [
        {"seed": seed, "return_mean": mean, "return_std": 1.0, "returns": [mean]}
        for seed, mean in ((0, 99.0), (1, np.nan))
    ]
    file.append(300, {"seeds": seeds})
    assert file.best == EvaluationsFile(path).best == 200
    file.cut(1000, 2)
    assert file.best == EvaluationsFile(path).best == 200
