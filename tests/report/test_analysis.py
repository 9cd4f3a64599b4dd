"""Groups and what is said of them."""

import copy

import numpy as np
import pytest

from dgae_jax.report import analysis
from tests.report.rows import plain, row


def with_setting(rows, **critic):
    changed = copy.deepcopy(rows)
    for each in changed:
        each["config"]["critic"] |= critic
        each["hash"], each["cell"] = "another", "z" + each["cell"]
    return changed


def test_groups_come_by_task_and_algorithm_however_the_rows_finished(grouped):
    rows = [
        row("walker2d", "da2c"),
        row("hopper", "dppo", 1),
        row("ant", "ppo"),
        row("hopper", "ppo"),
        row("hopper", "dppo", 0),
    ]
    found = grouped(rows)
    assert [(g.task, g.algo, [r.seed for r in g.rows]) for g in found] == [
        ("ant-v4", "ppo", [0]), ("hopper-v4", "ppo", [0]), ("hopper-v4", "dppo", [0, 1]), ("walker2d-v4", "da2c", [0]),
    ]  # fmt: skip


def test_other_settings_of_an_algorithm_are_a_group_of_their_own_that_says_what_differs(grouped):
    first, second = grouped(
        [*plain([1, 2]), *with_setting(plain([5]), target="bellman", quantiles=8)]
    )
    assert (first.name, first.finals.tolist()) == ("DPPO", [1, 2])
    assert (second.name, second.finals.tolist(), second.number) == (
        "DPPO (critic.target bellman, critic.quantiles 8)",
        [5],
        1,
    )


def test_groups_of_an_algorithm_stand_as_in_the_study_and_their_rows_by_seed(grouped):
    wide, plainly = with_setting(plain([7, 8]), quantiles=8), plain([1, 2])
    first, second = grouped([wide[1], wide[0], plainly[1], plainly[0]])
    assert (first.finals.tolist(), second.finals.tolist()) == ([7, 8], [1, 2])


def test_the_pairs_are_the_papers():
    assert list(analysis.pairs()) == [("dppo", "ppo"), ("dtrpo", "trpo"), ("da2c", "a2c")]


def test_improvement_is_told_per_task_and_over_the_tasks_that_have_both(grouped):
    rows = (
        plain([1, 3], "hopper", "dppo")
        + plain([2, 2], "hopper", "ppo")
        + plain([9, 9], "ant", "dppo")
        + plain([1, 1], "ant", "ppo")
    )
    found = analysis.improvements(grouped(rows + plain([1, 2], "swimmer", "dppo")))
    assert [(duel.task, duel.estimate.value) for duel in found] == [
        ("ant-v4", 1.0),
        ("hopper-v4", 0.5),
        (analysis.ALL, 0.75),
    ]
    np.testing.assert_array_equal(found[1].estimate.interval, [0, 1])
    assert analysis.improvements(grouped(plain([1, 3]))) == []


def test_scores_are_shares_of_the_best_mean_of_their_task(grouped):
    scores = analysis.normalised(
        grouped(
            plain([1, 3], "hopper", "dppo")
            + plain([1, 7], "hopper", "ppo")
            + plain([-5], "ant", "ppo")
        )
    )
    assert {name: [s.tolist() for s in strata] for name, (_, strata) in scores.items()} == {
        "PPO": [[0.25, 1.75]],  # the best mean is 4; Ant's best is negative
        "DPPO": [[0.25, 0.75]],
    }


def test_samples_to_reach_are_those_of_the_mean_of_the_seeds(grouped):
    def curve(*values):
        return {"curve": {"steps": [10, 20, 30], "return": list(values)}}

    slow = [
        row("hopper", "ppo", 0, **curve(0, 4, 10)),
        row("hopper", "ppo", 1, **curve(0, 8, 10)),
    ]  # mean 0, 6, 10
    groups = grouped(
        [
            *slow,
            row("hopper", "dppo", 0, **curve(5, 8, 8)),
            row("hopper", "a2c", 0, **curve(None, None, None)),
        ]
    )
    best = analysis.best_mean(groups)
    assert best == 10
    assert {g.name: analysis.reached(g, best) for g in groups} == {
        "PPO": [20, 30],
        "DPPO": [10, None],
        "A2C": [None, None],
    }


@pytest.mark.parametrize("best", [None, -3.0, 0.0])
def test_shares_of_a_best_that_is_not_positive_are_not_reached(grouped, best):
    assert analysis.reached(grouped([row()])[0], best) == [None, None]
