"""What several seeds say, against numbers worked out by hand and against SciPy."""

import numpy as np
import pytest
from scipy import stats

from dgae_jax.report import statistics as st


def test_mean_and_sample_standard_deviation():
    assert st.mean_std(np.array([1.0, 2.0, 3.0])) == (2.0, 1.0)  # (1 + 0 + 1) / 2 = 1
    assert st.mean_std(np.array([4.0])) == (4.0, None)


@pytest.mark.parametrize(
    ("scores", "mean"),
    [
        ([8, 1, 7, 2, 6, 3, 5, 4], 4.5),  # two of eight off at each end: (3 + 4 + 5 + 6) / 4
        ([0, 0, 10, 100], 5.0),  # one of four
        ([1, 2, 6], 3.0),  # a quarter of three is no whole score
        ([7], 7.0),
    ],
)
def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end(scores, mean):
    assert st.interquartile_mean([np.array(scores, float)]) == mean


def test_the_probability_of_improvement_counts_ties_half_and_tasks_alike():
    x, y = np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.0])
    assert st.improvement([x], [y]) == 0.5  # of six pairs two are won and two are ties: (2 + 1) / 6
    assert (
        st.improvement([x, np.array([5.0])], [y, np.array([1.0, 9.0, 9.0, 9.0])])
        == (0.5 + 0.25) / 2
    )


def test_a_profile_is_the_share_of_runs_above_each_score():
    shares = st.performance_profile(
        [np.array([0.1, 0.5]), np.array([0.9])], np.array([0.0, 0.1, 0.5, 0.95])
    )
    np.testing.assert_allclose(shares, [1, 2 / 3, 1 / 3, 0])


def test_the_interval_of_two_seeds_lies_between_them():
    """Of the draws a quarter is twice the lower and a quarter twice the higher."""
    np.testing.assert_array_equal(
        st.interval(st.interquartile_mean, [np.array([1.0, 3.0])]), [1, 3]
    )


def test_seeds_are_drawn_within_their_task():
    """Three zeros and three ones stay so in each draw; drawn from all six, their mean would vary."""
    strata = [np.zeros(3), np.ones(3)]
    np.testing.assert_array_equal(st.interval(st.interquartile_mean, strata), [0.5, 0.5])
    low, high = st.interval(st.interquartile_mean, [np.concatenate(strata)])
    assert low < 0.25 < 0.75 < high


def test_a_task_with_a_single_seed_has_no_interval():
    assert st.interval(st.interquartile_mean, [np.array([1.0])]) is None
    assert st.interval(st.improvement, [np.array([1.0, 2.0])], [np.array([1.0])]) is None


def test_the_same_scores_give_the_same_interval_and_leave_numpys_generator_alone():
    scores = [np.random.default_rng(1).normal(size=9)]
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    np.testing.assert_array_equal(
        st.interval(st.interquartile_mean, scores), st.interval(st.interquartile_mean, scores)
    )
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002


def test_the_interval_of_a_mean_is_that_of_the_normal_distribution_where_there_are_many_seeds():
    scores = np.random.default_rng(0).normal(10, 2, 400)
    low, high = st.interval(lambda strata: strata[0].mean(-1), [scores])
    error = 1.96 * scores.std(ddof=1) / 20
    np.testing.assert_allclose(
        [low - scores.mean(), high - scores.mean()], [-error, error], rtol=0.05
    )


def test_the_difference_of_two_samples_is_second_minus_first_and_both_are_drawn():
    first, second = np.array([1.0, 3.0]), np.array([10.0, 10.0])
    apart = st.difference(st.interquartile_mean)
    assert apart([first], [second]) == 8
    np.testing.assert_array_equal(st.interval(apart, [first], [second]), [7, 9])


@pytest.fixture(scope="module")
def scores():
    """Of two algorithms [seeds, tasks], of which some tie."""
    generator = np.random.default_rng(5)
    return generator.normal(1.0, 0.3, (10, 3)).round(1), generator.normal(0.9, 0.3, (8, 3)).round(1)


def test_point_values_are_those_of_scipy(scores):
    x, y = scores
    assert st.interquartile_mean(list(x.T)) == pytest.approx(
        stats.trim_mean(x, 0.25, axis=None), rel=1e-14
    )
    won = stats.mannwhitneyu(x, y).statistic / (
        len(x) * len(y)
    )  # per task: pairs won, ties counted half
    assert st.improvement(list(x.T), list(y.T)) == pytest.approx(won.mean(), rel=1e-14)
    taus = np.linspace(0, 2, 21)
    above = 1 - stats.ecdf(x.ravel()).cdf.evaluate(taus)
    np.testing.assert_allclose(st.performance_profile(list(x.T), taus), above, atol=1e-14)


def _iqm(*tasks, axis):
    return stats.trim_mean(np.concatenate(tasks, axis), 0.25, axis=axis)


def _wins(*tasks, axis):
    half = len(tasks) // 2
    pairs = zip(tasks[:half], tasks[half:], strict=True)
    return np.mean(
        [
            stats.mannwhitneyu(x, y, axis=axis).statistic / (x.shape[axis] * y.shape[axis])
            for x, y in pairs
        ],
        axis=0,
    )


@pytest.mark.parametrize("theirs", [_iqm, _wins])
def test_intervals_are_those_of_scipys_bootstrap_up_to_chance(theirs, scores):
    """Tasks are SciPy's independent samples. The ends are sure to about 2 % of an interval's width; four such errors are allowed."""
    x, y = (list(each.T) for each in scores)
    samples, ours = ((x,), st.interquartile_mean) if theirs is _iqm else ((x, y), st.improvement)
    tasks, how = (
        [task for strata in samples for task in strata],
        {"method": "percentile", "vectorized": True, "batch": 500},
    )
    known = stats.bootstrap(
        tasks, theirs, n_resamples=5000, rng=np.random.default_rng(7), **how
    ).confidence_interval
    np.testing.assert_allclose(
        st.interval(ours, *samples), known, atol=0.08 * (known.high - known.low)
    )


def test_curves_are_compared_at_the_steps_that_all_of_them_cover():
    nan = np.nan
    one = np.array([10.0, 20, 30, 40]), np.array([nan, 2, 3, 4])
    two = np.array([15.0, 25, 35]), np.array([0.0, 10, 20])
    steps, values = st.common_curve([one, two])
    np.testing.assert_array_equal(steps, [20, 25, 30, 35])  # from one's first value to two's last
    np.testing.assert_array_equal(values, [[2, 2.5, 3, 3.5], [5, 10, 15, 20]])


def test_curves_with_the_same_steps_are_what_they_are_and_nulls_between_are_bridged():
    steps = np.array([1.0, 2, 3])
    at, values = st.common_curve(
        [(steps, np.array([1.0, np.nan, 5])), (steps, np.array([4.0, 5, 6]))]
    )
    np.testing.assert_array_equal(at, steps)
    np.testing.assert_array_equal(values, [[1, 3, 5], [4, 5, 6]])


def test_curves_without_values_are_left_out_and_curves_that_do_not_meet_have_no_steps():
    steps, none = np.array([1.0, 2]), np.array([np.nan, np.nan])
    assert st.common_curve([(steps, none)])[1].shape == (0, 0)
    assert st.common_curve([(steps, none), (steps, steps)])[1].tolist() == [[1, 2]]
    at, values = st.common_curve([(steps, steps), (steps + 5, steps)])
    assert (at.size, values.size) == (0, 0)


def test_many_steps_are_thinned_and_the_first_and_last_stay():
    steps = np.arange(1.0, 1001)
    at, values = st.common_curve([(steps, steps**2)])
    assert (len(at), at[0], at[-1]) == (200, 1, 1000)
    np.testing.assert_array_equal(values[0], at**2)


def test_samples_to_reach_is_the_first_step_at_or_above():
    steps, values = np.array([10.0, 20, 30]), np.array([1.0, 5, 4])
    assert [st.steps_to_reach(steps, values, t) for t in (0.5, 4, 5, 6)] == [10, 20, 20, None]
