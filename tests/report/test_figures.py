"""What the figures show, read from their artists and from the files."""

import io

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.image import imread

from dgae_jax.configs.algorithms import ALGORITHMS, Row
from dgae_jax.configs.parts import CRITICS, UPDATES
from dgae_jax.report import analysis, figures
from dgae_jax.report.published import Published
from dgae_jax.report.style import look
from tests.report.rows import plain, row, whole


def test_a_pair_of_algorithms_has_one_colour_and_the_scalar_one_is_dashed():
    looks = {name: look(name) for name in ALGORITHMS}
    assert [looks[better].colour == looks[worse].colour for better, worse in analysis.pairs()] == [
        True
    ] * 3
    assert len({each.colour for each in looks.values()}) == 3
    assert {name for name, each in looks.items() if each.line == "--"} == {"ppo", "trpo", "a2c"}
    assert {each.line for each in looks.values()} == {"-", "--"}


def test_rows_of_ones_own_have_a_marker_or_a_colour_that_no_other_has(monkeypatch):
    monkeypatch.setitem(CRITICS, "wide", CRITICS["quantile"])
    monkeypatch.setitem(UPDATES, "careful", UPDATES["clip"])
    monkeypatch.setitem(
        ALGORITHMS, "target", Row("quantile", "distributional", "lambda-return", "clip")
    )
    monkeypatch.setitem(ALGORITHMS, "network", Row("wide", "distributional", "sr-lambda", "clip"))
    monkeypatch.setitem(ALGORITHMS, "update", Row("scalar", "td", "lambda-return", "careful"))
    assert len({look(algo) for algo in ALGORITHMS}) == 9
    assert [
        look(algo).colour == look("dppo").colour for algo in ("target", "network", "update")
    ] == [True, True, False]
    assert [look(algo).line for algo in ("target", "network", "update")] == ["-", "-", "--"]


def test_learning_curves_are_mean_and_standard_deviation_over_seeds(grouped):
    first = row("hopper", "dppo", 0, curve={"steps": [10, 20], "return": [1, 3]})
    second = row("hopper", "dppo", 1, curve={"steps": [10, 20], "return": [3, 7]})
    (axes,) = figures.learning_curves(grouped([first, second])).axes
    (line,) = axes.lines
    np.testing.assert_array_equal(line.get_xydata(), [[10, 2], [20, 5]])
    edge = axes.collections[0].get_paths()[0].vertices
    low, high = (find(edge[edge[:, 0] == 20, 1]) for find in (np.min, np.max))
    np.testing.assert_allclose(
        [low, high], [5 - 8**0.5, 5 + 8**0.5]
    )  # deviations ∓2: variance 4 + 4 over 1


def test_a_complete_study_has_a_panel_per_task_with_six_lines_and_one_legend(grouped):
    figure = figures.learning_curves(grouped(whole(seeds=2)))
    assert [axes.get_title() for axes in figure.axes] == [
        "ant-v4",
        "hopper-v4",
        "swimmer-v4",
        "walker2d-v4",
    ]
    assert {len(axes.lines) for axes in figure.axes} == {6}
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "PPO",
        "DPPO",
        "TRPO",
        "DTRPO",
        "A2C",
        "DA2C",
    ]
    for axes in figure.axes:
        for line in axes.lines:
            style = look(line.get_label().lower())
            assert (to_hex(line.get_color()), line.get_linestyle()) == (
                style.colour.lower(),
                style.line,
            )


def test_published_results_are_marked_where_the_task_and_the_budget_have_them(grouped):
    known = [
        Published("hopper", 1_000_000, "PPO", 2609.0, 701.0, 10, "x"),
        Published(
            "hopper", 3_000_000, "PPO", 3128.0, 413.0, None, "x"
        ),  # beyond the study's budget
        Published("ant", 1_000_000, "PPO", 3258.0, None, None, "x"),
    ]
    (axes,) = figures.learning_curves(grouped([row()]), known).axes
    crosses = [line.get_xydata().tolist() for line in axes.lines if line.get_marker() == "x"]
    assert crosses == [[[1_015_000, 2609]]]  # beside its samples
    (legend,) = axes.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["DPPO", "PPO, published"]


def test_final_returns_are_dots_at_the_iqm_bars_of_the_interval_and_ticks_of_the_seeds(grouped):
    (axes,) = figures.final_returns(
        grouped(plain([1, 3], algo="dppo") + plain([7], algo="ppo"))
    ).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["PPO", "DPPO"]
    drawn = [line.get_xydata().tolist() for line in axes.lines]
    assert drawn == [
        [[7, 0]],
        [[7, 0]],
        [[1, 1], [3, 1]],
        [[1, 1], [3, 1]],
        [[2, 1]],
    ]  # ticks, bar where there is one, dot


def test_the_profile_of_one_task_starts_with_all_runs_and_ends_with_none(grouped):
    (axes,) = figures.performance_profile(grouped(plain([1, 3]))).axes
    shares = axes.lines[0].get_xydata()
    np.testing.assert_array_equal(shares[[0, -1], 1], [1, 0])
    assert shares[np.searchsorted(shares[:, 0], 1.0), 1] == 0.5  # 1.5 is above, 0.5 is not


AWKWARD = {
    "one seed": [row()],
    "two seeds": [row(seed=0), row(seed=1)],
    "one of a pair": [row("hopper", "ppo")],
    "Brax's own": [row() | {"env": "brax:ant", "env_version": None}],
    "missing cells": [
        row("ant", "ppo", 0),
        row("ant", "dppo", 0),
        row("ant", "dppo", 1),
        row("hopper", "a2c", 0),
    ],
    "no episode ended": [row(curve={"steps": [1, 2], "return": [None, None]})],
    "an empty curve": [row(curve={"steps": [], "return": []})],
    "negative returns": plain([-5, -3], curve={"steps": [1, 2], "return": [-9, -4]}),
    "zero returns": plain([0.0, 0.0]),
    "three tasks": whole(("ant", "hopper", "swimmer"), ("ppo", "dppo"), 1),
}


@pytest.mark.parametrize("rows", AWKWARD.values(), ids=AWKWARD)
def test_awkward_studies_are_drawn_without_a_warning(rows, grouped, tmp_path):
    groups = grouped(rows)
    found = analysis.improvements(groups)
    drawn = [
        figures.learning_curves(groups),
        figures.final_returns(groups),
        figures.speed(groups),
        figures.performance_profile(groups),
    ]
    for number, figure in enumerate([*drawn, *([figures.improvement(found)] if found else [])]):
        for path in figures.save(figure, tmp_path / f"{number}"):
            assert path.stat().st_size > 1000


def test_a_figure_is_written_as_png_and_svg_on_white_with_text_that_stays_text(grouped, tmp_path):
    figure = figures.learning_curves(grouped([row()]))
    png, svg = figures.save(figure, tmp_path / "x")
    assert (png.name, svg.name) == ("x.png", "x.svg")
    image = imread(png)
    np.testing.assert_array_equal(image[0, 0, :3], 1)
    blue = np.array([0, 0x72, 0xB2]) / 255
    assert np.mean(np.abs(image[..., :3] - blue).max(-1) < 0.05) > 0.001
    assert ">hopper-v4</text>" in svg.read_text()


def test_the_same_results_give_the_same_bytes_and_matplotlibs_settings_stay(grouped):
    before = dict(mpl.rcParams)
    groups = grouped([row()])
    assert figures.svg(figures.learning_curves(groups)) == figures.svg(
        figures.learning_curves(groups)
    )
    assert dict(mpl.rcParams) == before
    assert imread(io.BytesIO(figures._written(figures.speed(groups), "png"))).ndim == 3
