"""Figures, read from their artists and from the files."""

import io

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.image import imread

from dgae_jax.configs.algorithms import ALGORITHMS, Row
from dgae_jax.configs.parts import UPDATES
from dgae_jax.report import analysis, figures, page
from dgae_jax.report.figures import look
from dgae_jax.report.results import Published
from tests.report.rows import plain, row, whole


def test_pair_of_algorithms_has_one_colour_and_the_scalar_one_is_dashed():
    looks = {name: look(name) for name in ALGORITHMS}
    colours = {name: each["color"] for name, each in looks.items()}
    assert all(colours[better] == colours[worse] for better, worse in analysis.pairs())
    assert len(set(colours.values())) == 3
    dashed = [name for name, each in looks.items() if each["linestyle"] == "--"]
    assert dashed == ["ppo", "trpo", "a2c"]


def test_custom_algorithms_have_a_look_of_their_own(monkeypatch):
    monkeypatch.setitem(UPDATES, "careful", UPDATES["clip"])
    custom = Row("quantile", "distributional", "lambda-return", "clip")
    monkeypatch.setitem(ALGORITHMS, "target", custom)
    monkeypatch.setitem(ALGORITHMS, "update", Row("scalar", "td", "lambda-return", "careful"))
    assert len({tuple(look(algo).values()) for algo in ALGORITHMS}) == 8
    assert look("target")["color"] == look("dppo")["color"]
    assert (look("update")["color"], look("update")["linestyle"]) == (figures.CUSTOM, "--")


def test_learning_curves_are_mean_and_standard_deviation_over_seeds(grouped):
    first = row("hopper", "dppo", 0, curve={"steps": [10, 20], "return": [1, 3]})
    second = row("hopper", "dppo", 1, curve={"steps": [10, 20], "return": [3, 7]})
    (axes,) = figures.learning_curves(grouped([first, second])).axes
    (line,) = axes.lines
    np.testing.assert_array_equal(line.get_xydata(), [[10, 2], [20, 5]])
    edge = axes.collections[0].get_paths()[0].vertices
    assert edge[:, 1].max() == pytest.approx(5 + 8**0.5)


def test_learning_curves_have_a_panel_per_task_and_one_legend(grouped):
    figure = figures.learning_curves(grouped(whole(("hopper", "ant"), ("ppo", "a2c"), 1)))
    assert [axes.get_title() for axes in figure.axes] == ["ant-v4", "hopper-v4"]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["PPO", "A2C"]


def test_published_results_are_marked_within_the_budget_of_their_task(grouped):
    known = [
        Published("hopper", 1_000_000, "PPO", 2609.0, 701.0, 10, "x"),
        Published("hopper", 3_000_000, "PPO", 3128.0, 413.0, None, "x"),  # beyond the budget
        Published("ant", 1_000_000, "PPO", 3258.0, None, None, "x"),
    ]
    (axes,) = figures.learning_curves(grouped([row()]), known).axes
    crosses = [line.get_xydata().tolist() for line in axes.lines if line.get_marker() == "x"]
    assert crosses == [[[1_015_000, 2609]]]  # beside its samples


def test_final_returns_are_ticks_of_seeds_a_bar_and_a_dot(grouped):
    groups = grouped(plain([1, 3], algo="dppo") + plain([7], algo="ppo"))
    (axes,) = figures.final_returns(groups).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["PPO", "DPPO"]
    drawn = [line.get_xydata().tolist() for line in axes.lines]
    ppo, dppo = [[[7, 0]], [[7, 0]]], [[[1, 1], [3, 1]], [[1, 1], [3, 1]], [[2, 1]]]
    assert drawn == [*ppo, *dppo]  # a single seed has no bar


def test_pit_histogram_has_a_panel_per_critic_with_its_coverage():
    found = {"a": ("dppo", {"pit": [0.5, 0.5], "coverage_90": 0.874})}
    found["b"] = ("dtrpo", {"pit": [0.25, 0.75], "coverage_90": float("nan")})
    one, two = figures.pit_histograms(found).axes
    assert "87 %" in one.get_title()
    assert "fewer than 10 quantiles" in two.get_title()
    assert [bar.get_height() for bar in two.patches] == [0.25, 0.75]


NO_CURVE = {"steps": [1, 2], "return": [None, None]}

AWKWARD = {
    "noisy env without a version": [row() | {"env": "brax:ant", "env_version": None}],
    "missing runs": [row("ant", "ppo"), row("ant", "dppo"), row("hopper", "a2c")],
    "no episode ended": [row(curve=NO_CURVE), row(seed=1, curve={"steps": [], "return": []})],
    "negative returns": plain([-5, -3], curve={"steps": [1, 2], "return": [-9, -4]}),
}


@pytest.mark.parametrize("rows", AWKWARD.values(), ids=AWKWARD)
def test_awkward_sweeps_are_drawn_without_a_warning(rows, grouped):
    groups = grouped(rows)
    for _, figure in page.drawn(groups, []):
        assert figures.image(figure, "svg").rstrip().endswith(b"</svg>")


def test_figure_is_png_on_white_and_svg_with_text(grouped):
    before, groups = dict(mpl.rcParams), grouped([row()])
    png, svg, again = (
        figures.image(figures.final_returns(groups), kind) for kind in ("png", "svg", "svg")
    )
    np.testing.assert_array_equal(imread(io.BytesIO(png))[0, 0, :3], 1)
    assert b">hopper-v4</text>" in svg
    assert svg == again
    assert dict(mpl.rcParams) == before
