"""Figures of a report: one look per algorithm, white paper, readable alone."""

import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.parts import CRITICS
from dgae_jax.report import analysis
from dgae_jax.report.groups import Group, by_task
from dgae_jax.report.results import Published
from dgae_jax.run import files

PANEL = (4.5, 3.3)
"""Size of a panel [inches]: its text is legible on a phone, where a panel fills the width."""

# colours of Okabe and Ito, told apart with any colour vision
COLOURS = {"clip": "#0072B2", "trust-region": "#D55E00", "gradient": "#009E73"}
"""Colours of the policy updates."""
CUSTOM, PUBLISHED, INK, FAINT = "#56B4E9", "#CC79A7", "#222222", "#777777"

MARKERS = ("", "o", "s", "^", "D", "v", "P", "X")
"""Markers of groups whose colour and line another group has."""

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": FAINT,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "dgae",  # the same figure gives the same bytes
}


class Look(NamedTuple):
    """Style of a line, and of its dot."""

    colour: str
    line: str
    marker: str
    fill: str
    """Inside of the dot: white for a scalar critic."""


def look(algo: str, number: int = 0) -> Look:
    """Return the look of an algorithm: a colour per policy update, dashed for a scalar critic.

    Args:
        algo: Name of the algorithm.
        number: Number of the group among those of the algorithm.
    """

    def kind(name: str) -> tuple[str, bool]:
        return ALGORITHMS[name].policy_update, "quantiles" in CRITICS[ALGORITHMS[name].critic]

    update, distribution = kind(algo)
    colour = COLOURS.get(update, CUSTOM)
    alike = [name for name in ALGORITHMS if kind(name) == (update, distribution)]
    marker = MARKERS[(number + alike.index(algo)) % len(MARKERS)]
    return Look(colour, *(("-", marker, colour) if distribution else ("--", marker, "white")))


class Mark(NamedTuple):
    """A row of a dot plot: a value with its interval, and single values."""

    label: str
    look: Look
    estimate: analysis.Estimate
    dots: np.ndarray


def learning_curves(groups: Iterable[Group], published: Sequence[Published] = ()) -> Figure:
    """Draw the return during training per task: mean over seeds ± one standard deviation.

    Args:
        groups: The groups.
        published: Published results, drawn as crosses up to the samples of the groups.
    """

    def draw(axes: Axes, members: Sequence[Group]) -> None:
        for group in members:
            _curve(axes, group)
        _crosses(axes, members, published)
        axes.set(xlabel="environment steps", ylabel="episode return")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.margins(x=0.02)

    return _panels(groups, draw, PANEL[1], legend=True)


def _curve(axes: Axes, group: Group) -> None:
    steps, curve = group.curve
    if curve.size:
        std = curve.std(0, ddof=min(1, len(curve) - 1))
        _line(axes, group, steps, curve.mean(0), markevery=0.1)
        _shade(axes, group, steps, curve.mean(0) - std, curve.mean(0) + std)


def _line(axes: Axes, group: Group, x: np.ndarray, y: np.ndarray, markevery: float) -> None:
    colour, line, marker, _ = look(group.algo, group.number)
    style = {"color": colour, "marker": marker, "markevery": markevery, "markersize": 4}
    axes.plot(x, y, line, label=group.name, **style)


def _shade(axes: Axes, group: Group, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    colour = look(group.algo, group.number).colour
    axes.fill_between(x, low, high, color=colour, alpha=0.12, linewidth=0)


def _crosses(axes: Axes, members: Sequence[Group], published: Sequence[Published]) -> None:
    end = max(row.total_steps for group in members for row in group.rows)
    env = members[0].rows[0].env
    known = [one for one in published if one.task == env and one.samples <= end]
    for number, one in enumerate(known, start=1):
        algo = one.algorithm.lower()
        colour = look(algo).colour if algo in ALGORITHMS else PUBLISHED
        at = one.samples + number * 0.015 * end  # a little to the right, beside each other
        style = {"fmt": "x", "markersize": 5, "capsize": 2, "linewidth": 1, "color": colour}
        axes.errorbar(at, one.mean, one.spread, label=f"{one.algorithm}, published", **style)


def final_returns(groups: Iterable[Group]) -> Figure:
    """Draw the interquartile mean of the final returns with its interval, and each seed."""

    def draw(axes: Axes, members: Sequence[Group]) -> None:
        _dots(axes, [_mark(g, analysis.interquartile_mean(g.finals), g.finals) for g in members])
        axes.set_xlabel("return of the final policy")

    return _dot_panels(groups, draw)


def speed(groups: Iterable[Group]) -> Figure:
    """Draw the mean samples per second, and each seed."""

    def draw(axes: Axes, members: Sequence[Group]) -> None:
        rates = [np.array([row.samples_per_second for row in group.rows]) for group in members]
        means = [analysis.Estimate(rate.mean(), None) for rate in rates]
        _dots(axes, [_mark(*each) for each in zip(members, means, rates, strict=True)])
        axes.set_xlabel("samples per second")
        axes.set_xlim(0, 1.1 * max(rate.max() for rate in rates))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))

    return _dot_panels(groups, draw)


def improvement(found: Sequence[analysis.Improvement]) -> Figure:
    """Draw the probability of improvement per task and pair of algorithms."""
    marks = [
        _mark(duel.better, duel.estimate)._replace(
            label=f"{duel.better.name} > {duel.worse.name}\n{duel.task}"
        )
        for duel in found
    ]
    with mpl.rc_context(STYLE):
        figure = _figure(PANEL[0], _height(len(marks), 0.4))
        axes = figure.subplots()
        _dots(axes, marks)
        axes.axvline(0.5, color=FAINT, linewidth=1)
        axes.set(title="Distributional against scalar", xlabel="probability of improvement")
        axes.set_xlim(-0.03, 1.03)
        axes.xaxis.set_major_formatter(PercentFormatter(1))
    return figure


def performance_profile(groups: Iterable[Group]) -> Figure:
    """Draw the share of runs above each normalised score, with its interval."""
    scores = analysis.normalised(groups)
    top = max((s.max() for _, strata in scores.values() for s in strata), default=1.0)
    taus = np.linspace(0, 1.05 * top, 200)
    with mpl.rc_context(STYLE):
        figure = _figure(*PANEL)
        axes = figure.subplots()
        for group, strata in scores.values():
            ends = analysis.interval(lambda s: analysis.performance_profile(s, taus), strata)
            _line(axes, group, taus, analysis.performance_profile(strata, taus), markevery=20)
            if ends is not None:
                _shade(axes, group, taus, *ends)
        axes.set(title="Performance profile", xlabel="normalised score τ")
        axes.set(ylabel="share of runs above τ", ylim=(-0.02, 1.02))
        axes.yaxis.set_major_formatter(PercentFormatter(1))
        _legend(figure, [axes])
    return figure


def coverage(statistics: Mapping[str, Any]) -> str:
    """Describe how many returns a critic's central 90 % interval holds.

    Args:
        statistics: Result of `run.calibration`.
    """
    share = statistics["coverage_90"]
    if math.isnan(share):
        return "fewer than 10 quantiles have no central 90 %"
    return f"{100 * share:.0f} % of the returns in the central 90 %"


def pit_histograms(found: Mapping[str, tuple[str, dict[str, Any]]]) -> Figure:
    """Draw a histogram of the probability integral transform per critic.

    It is flat for a calibrated critic and U-shaped for a distribution that is too narrow.

    Args:
        found: Algorithm and statistics (`run.calibration`) of each critic, by its name.
    """
    with mpl.rc_context(STYLE):
        columns = min(3, len(found))
        rows = -(-len(found) // columns)
        figure = _figure(PANEL[0] * columns, PANEL[1] * rows)
        panels = list(figure.subplots(rows, columns, sharey=True, squeeze=False).flat)
        for axes, (name, (algo, statistics)) in zip(panels, found.items(), strict=False):
            shares = np.array(statistics["pit"])
            edges = np.linspace(0, 1, len(shares) + 1)
            style = {"color": look(algo).colour, "edgecolor": "white", "linewidth": 0.5}
            axes.bar(edges[:-1], shares, np.diff(edges), align="edge", **style)
            axes.axhline(1 / len(shares), color=FAINT, linestyle=":", label="calibrated")
            axes.set(title=f"{name}\n{coverage(statistics)}", ylabel="returns")
            axes.set_xlabel("share of the quantiles below the observed return")
            axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        for axes in panels[len(found) :]:
            axes.remove()
        panels[0].legend()
    return figure


def _mark(group: Group, estimate: analysis.Estimate, dots: np.ndarray | None = None) -> Mark:
    style = look(group.algo, group.number)
    return Mark(group.name, style, estimate, np.empty(0) if dots is None else dots)


def _dots(axes: Axes, marks: Sequence[Mark]) -> None:
    """Draw rows from top to bottom: ticks, the interval, the value."""
    for y, (_, (colour, _, marker, fill), estimate, dots) in enumerate(marks):
        faint = {"color": colour, "alpha": 0.6}
        axes.plot(dots, np.full(len(dots), y), "|", markersize=7, **faint)
        if estimate.interval is not None:
            style = {"linewidth": 2.2, "solid_capstyle": "butt", **faint}
            axes.plot(estimate.interval, [y, y], "-", **style)
        style = {"color": colour, "markerfacecolor": fill, "markersize": 6, "zorder": 3}
        axes.plot(estimate.value, y, marker or "o", **style)
    axes.set_yticks(range(len(marks)), [mark.label for mark in marks])
    axes.set_ylim(len(marks) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained", dpi=150)


def _height(rows: int, each: float = 0.28) -> float:
    return 0.9 + each * rows


Draw = Callable[[Axes, Sequence[Group]], None]


def _dot_panels(groups: Iterable[Group], draw: Draw) -> Figure:
    groups = list(groups)
    return _panels(groups, draw, _height(max(map(len, by_task(groups).values()))), legend=False)


def _panels(groups: Iterable[Group], draw: Draw, height: float, legend: bool) -> Figure:
    """Draw a panel per task, two side by side, and one legend for all."""
    tasks = by_task(groups)
    columns = min(2, len(tasks))
    rows = -(-len(tasks) // columns)
    with mpl.rc_context(STYLE):
        figure = _figure(columns * PANEL[0], rows * height + 0.5 * legend)
        figure.set_layout_engine("constrained", h_pad=0.1)
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes, (task, members) in zip(panels, tasks.items(), strict=False):
            draw(axes, members)
            axes.set_title(task)
        for axes in panels[len(tasks) :]:
            axes.remove()
        if legend:
            _legend(figure, panels[: len(tasks)])
    return figure


def _legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """Draw each label once below the panels, colour by colour, so that pairs share a column."""
    handles: dict[str, tuple[str, Any]] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            line = handle[0] if isinstance(handle, tuple) else handle  # cross of an error bar
            handles.setdefault(label, (line.get_color(), handle))
    colours = list(dict.fromkeys(colour for colour, _ in handles.values()))
    ordered = sorted(handles.items(), key=lambda item: colours.index(item[1][0]))
    if ordered:
        figure.legend(
            [handle for _, (_, handle) in ordered],
            [label for label, _ in ordered],
            loc="outside lower center",
            ncols=min(3, len(ordered)),
            fontsize=8,
            handlelength=2.4,
            columnspacing=1.2,
        )


def svg(figure: Figure) -> bytes:
    """Return the figure as SVG, the same bytes each time."""
    return _encoded(figure, "svg", metadata={"Date": None, "Creator": None})


def save(figure: Figure, path: Path) -> list[Path]:
    """Write `path`.png and `path`.svg, each complete or not at all."""
    data = {".png": _encoded(figure, "png"), ".svg": svg(figure)}
    written = [path.with_name(path.name + ending) for ending in data]
    for file, content in zip(written, data.values(), strict=True):
        files.replace(file, content)
    return written


def _encoded(figure: Figure, kind: str, **options) -> bytes:
    image = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(image, format=kind, **options)
    return image.getvalue()
