"""Groups and their comparisons, against numbers worked out by hand and against SciPy."""

import copy

import numpy as np
import pytest
from scipy import stats

from dgae_jax.report import analysis
from tests.report.rows import plain, row


def changed(rows, **critic):
    rows = copy.deepcopy(rows)
    for each in rows:
        each["config"]["critic"] |= critic
        each["seed"] += 10
    return rows


def test_groups_come_by_task_and_algorithm_in_any_order_of_rows(grouped):
    found = grouped([row("walker2d", "da2c"), row(seed=1), row("hopper", "ppo"), row()])
    hopper = [("hopper-v4", "PPO", 1), ("hopper-v4", "DPPO", 2)]
    expected = [*hopper, ("walker2d-v4", "DA2C", 1)]
    assert [(group.task, group.name, len(group.rows)) for group in found] == expected


def test_other_settings_are_a_group_named_by_the_differences(grouped):
    wide = changed(plain([7, 5]), target="bellman", quantiles=8)
    first, second = grouped([*plain([1, 2]), wide[1], wide[0]])
    assert (first.name, first.number, first.finals.tolist()) == ("DPPO", 0, [1, 2])
    assert (second.number, second.finals.tolist()) == (1, [7, 5])
    assert second.name == "DPPO (critic.target bellman, critic.quantiles 8)"


def test_improvement_is_estimated_per_task_and_over_common_tasks(grouped):
    hopper = plain([1, 3], "hopper", "dppo") + plain([2, 2], "hopper", "ppo")
    ant = plain([9, 9], "ant", "dppo") + plain([1, 1], "ant", "ppo")
    found = analysis.improvements(grouped(hopper + ant + plain([1, 2], "swimmer", "dppo")))
    values = [(duel.task, duel.estimate.value) for duel in found]
    assert values == [("ant-v4", 1.0), ("hopper-v4", 0.5), (analysis.ALL, 0.75)]
    np.testing.assert_array_equal(found[1].estimate.interval, [0, 1])
    assert analysis.improvements(grouped(plain([1, 3]))) == []


def test_improvement_counts_ties_half_and_agrees_with_scipy():
    generator = np.random.default_rng(5)
    x, y = generator.normal(1.0, 0.3, (3, 10)).round(1), generator.normal(0.9, 0.3, (3, 8)).round(1)
    won = np.mean([stats.mannwhitneyu(*both).statistic / 80 for both in zip(x, y, strict=True)])
    found = analysis.improvement(list(x), list(y))
    assert found.value == pytest.approx(won, rel=1e-14)
    assert found.interval[0] < won < found.interval[1]


def test_profile_is_the_share_of_seeds_above_each_score():
    strata = [np.array([0.1, 0.5]), np.array([0.9])]
    shares = analysis.performance_profile(strata, np.array([0.1, 0.5, 0.95]))
    np.testing.assert_allclose(shares, [2 / 3, 1 / 3, 0])


def test_scores_are_shares_of_the_best_mean_of_their_task(grouped):
    rows = (
        plain([1, 3], "hopper", "dppo")
        + plain([1, 7], "hopper", "ppo")  # the best mean is 4
        + plain([-5], "ant", "ppo")  # no positive mean: no score
    )
    scores = analysis.normalised(grouped(rows))
    found = {name: [s.tolist() for s in strata] for name, (_, strata) in scores.items()}
    assert found == {"PPO": [[0.25, 1.75]], "DPPO": [[0.25, 0.75]]}


def test_samples_to_reach_are_those_of_the_mean_over_seeds(grouped):
    def curve(*values):
        return {"curve": {"steps": [10, 20, 30], "return": list(values)}}

    rows = [
        row("hopper", "ppo", 0, **curve(0, 4, 10)),
        row("hopper", "ppo", 1, **curve(0, 8, 10)),  # mean 0, 6, 10
        row("hopper", "dppo", 0, **curve(5, 8, 8)),
        row("hopper", "a2c", 0, **curve(None, None, None)),
    ]
    best, steps = analysis.reached(grouped(rows))
    assert (best, steps) == (10, [[20, 30], [10, None], [None, None]])
    best, steps = analysis.reached(grouped([row(**curve(-9, -5, -3))]))
    assert (best, steps) == (-3, [[None, None]])


def test_curve_has_the_steps_that_all_seeds_have(grouped):
    def seed(number, *values):
        return row(seed=number, curve={"steps": [10, 20, 30], "return": list(values)})

    (group,) = grouped([seed(0, None, 2, 3), seed(1, 4, 5, 6), seed(2, None, None, None)])
    steps, values = group.curve
    assert (steps.tolist(), values.tolist()) == ([20, 30], [[2, 3], [5, 6]])
    (group,) = grouped([seed(0, None, None, None)])
    assert group.curve[1].size == 0
