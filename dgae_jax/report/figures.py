"""The figures of a report: one look per algorithm, white paper, readable alone."""

import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.report import analysis, statistics
from dgae_jax.report.groups import Group, by_task
from dgae_jax.report.published import Published
from dgae_jax.report.style import FAINT, INK, OTHER, Look, look
from dgae_jax.run import files

PANEL = (4.5, 3.3)
"""Size of a panel [inches]: its text is legible on a phone, where a panel is as wide as the screen."""

LOOK: dict[Any, Any] = {
    "font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": FAINT, "axes.grid": True,
    "grid.alpha": 0.3, "text.color": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK, "legend.frameon": False,
    "svg.fonttype": "none", "svg.hashsalt": "dgae", "lines.linewidth": 1.6,
}  # fmt: skip
"""Text stays text, and the same figure gives the same bytes."""


class Mark(NamedTuple):
    """A row of a dot plot: a value with its interval, and the single values behind it."""

    label: str
    look: Look
    estimate: analysis.Estimate
    dots: np.ndarray


def learning_curves(groups: Iterable[Group], published: Sequence[Published] = ()) -> Figure:
    """A panel per task: mean over seeds, ± one standard deviation, of the return while training; crosses are published results."""
    return _panels(
        groups, lambda axes, task, members: _curves(axes, task, members, published), PANEL[1]
    )


def _curves(
    axes: Axes, task: str, members: Sequence[Group], published: Sequence[Published]
) -> None:
    for group in members:
        steps, curve = group.curve
        if not curve.size:
            continue
        style, mean, std = (
            look(group.algo, group.number),
            curve.mean(0),
            curve.std(0, ddof=min(1, len(curve) - 1)),
        )
        axes.plot(
            steps,
            mean,
            style.line,
            color=style.colour,
            marker=style.marker,
            markevery=0.1,
            markersize=4,
            label=group.name,
        )
        axes.fill_between(
            steps, mean - std, mean + std, color=style.colour, alpha=0.12, linewidth=0
        )
    end = max(row.total_steps for group in members for row in group.rows)
    marks = [
        mark for mark in published if mark.task == members[0].rows[0].env and mark.samples <= end
    ]
    for number, mark in enumerate(
        marks
    ):  # beside each other, a little to the right of their samples
        known = mark.algorithm.lower() in ALGORITHMS
        colour, at = (
            look(mark.algorithm.lower()).colour if known else OTHER,
            mark.samples + (1 + number) * 0.015 * end,
        )
        label = f"{mark.algorithm}, published"
        axes.errorbar(
            at,
            mark.mean,
            mark.spread,
            fmt="x",
            markersize=5,
            capsize=2,
            linewidth=1,
            color=colour,
            label=label,
        )
    axes.set(title=task, xlabel="environment steps", ylabel="episode return")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.margins(x=0.02)


def final_returns(groups: Iterable[Group]) -> Figure:
    """A panel per task: interquartile mean of the final returns with its interval; a dot per seed."""
    groups = list(groups)

    def panel(axes: Axes, task: str, members: Sequence[Group]) -> None:
        marks = [
            Mark(g.name, look(g.algo, g.number), analysis.interquartile_mean(g.finals), g.finals)
            for g in members
        ]
        _dots(axes, marks)
        axes.set(title=task, xlabel="return of the last policy")

    return _panels(groups, panel, _height(max(map(len, by_task(groups).values()))), legend=False)


def speed(groups: Iterable[Group]) -> Figure:
    """A panel per task: mean samples per second, a dot per seed."""
    groups = list(groups)

    def panel(axes: Axes, task: str, members: Sequence[Group]) -> None:
        rates = [np.array([row.samples_per_second for row in group.rows]) for group in members]
        _dots(
            axes,
            [
                Mark(g.name, look(g.algo, g.number), analysis.Estimate(r.mean(), None), r)
                for g, r in zip(members, rates, strict=True)
            ],
        )
        axes.set(title=task, xlabel="samples per second")
        axes.set_xlim(0, 1.1 * max(rate.max() for rate in rates))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))

    return _panels(groups, panel, _height(max(map(len, by_task(groups).values()))), legend=False)


def improvement(found: Sequence[analysis.Improvement]) -> Figure:
    """Probability that a seed with a distribution scores more than one without, per task and pair."""
    marks = [
        Mark(
            f"{duel.better.name} > {duel.worse.name}\n{duel.task}",
            look(duel.better.algo, duel.better.number),
            duel.estimate,
            np.empty(0),
        )
        for duel in found
    ]
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(PANEL[0], _height(len(marks), 0.4)), layout="constrained", dpi=150)
        axes = figure.subplots()
        _dots(axes, marks)
        axes.axvline(0.5, color=FAINT, linewidth=1)
        axes.set(
            title="Distribution against scalar",
            xlabel="probability of improvement",
            xlim=(-0.03, 1.03),
        )
        axes.xaxis.set_major_formatter(PercentFormatter(1))
    return figure


def performance_profile(groups: Iterable[Group]) -> Figure:
    """Share of runs above each normalised score, with its interval."""
    scores = analysis.normalised(groups)
    top = max((s.max() for _, strata in scores.values() for s in strata), default=1.0)
    taus = np.linspace(0, 1.05 * top, 200)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=PANEL, layout="constrained", dpi=150)
        axes = figure.subplots()
        for name, (group, strata) in scores.items():
            style, between = (
                look(group.algo, group.number),
                statistics.interval(lambda s: statistics.performance_profile(s, taus), strata),
            )
            shares = statistics.performance_profile(strata, taus)
            axes.plot(
                taus,
                shares,
                style.line,
                color=style.colour,
                marker=style.marker,
                markevery=20,
                markersize=4,
                label=name,
            )
            if between is not None:
                axes.fill_between(taus, *between, color=style.colour, alpha=0.12, linewidth=0)
        axes.set(
            title="Performance profile",
            xlabel="normalised score τ",
            ylabel="share of runs above τ",
            ylim=(-0.02, 1.02),
        )
        axes.yaxis.set_major_formatter(PercentFormatter(1))
        _legend(figure, [axes])
    return figure


def _dots(axes: Axes, marks: Sequence[Mark]) -> None:
    """Rows from top to bottom."""
    for y, mark in enumerate(marks):
        axes.plot(
            mark.dots,
            np.full(len(mark.dots), y),
            "|",
            color=mark.look.colour,
            markersize=7,
            alpha=0.6,
        )
        if mark.estimate.interval is not None:
            axes.plot(
                mark.estimate.interval,
                [y, y],
                "-",
                color=mark.look.colour,
                linewidth=2.2,
                alpha=0.6,
                solid_capstyle="butt",
            )
        shape = mark.look.marker or "o"
        axes.plot(
            mark.estimate.value,
            y,
            shape,
            color=mark.look.colour,
            markerfacecolor=mark.look.fill,
            markersize=6,
            zorder=3,
        )
    axes.set_yticks(range(len(marks)), [mark.label for mark in marks])
    axes.set_ylim(len(marks) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)


def _height(rows: int, each: float = 0.28) -> float:
    return 0.9 + each * rows


def _panels(
    groups: Iterable[Group],
    draw: Callable[[Axes, str, Sequence[Group]], None],
    height: float,
    legend: bool = True,
) -> Figure:
    """A panel per task, two side by side, and one legend for all."""
    tasks = by_task(groups)
    columns = min(2, len(tasks))
    rows = -(-len(tasks) // columns)
    with mpl.rc_context(LOOK):
        figure = Figure(
            figsize=(columns * PANEL[0], rows * height + 0.5 * legend),
            layout="constrained",
            dpi=150,
        )
        figure.set_layout_engine("constrained", h_pad=0.1)
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes, (task, members) in zip(panels, tasks.items(), strict=False):
            draw(axes, task, members)
        for axes in panels[len(tasks) :]:
            axes.remove()
        if legend:
            _legend(figure, panels[: len(tasks)])
    return figure


def _legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """Every label once, below the panels; what has the same colour together, so that pairs stand in columns."""
    handles: dict[str, tuple[str, Any]] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            line = handle[0] if isinstance(handle, tuple) else handle  # of an error bar, its cross
            handles.setdefault(label, (line.get_color(), handle))
    colours = list(dict.fromkeys(colour for colour, _ in handles.values()))
    ordered = sorted(handles.items(), key=lambda item: colours.index(item[1][0]))
    if ordered:
        labels, shown = [label for label, _ in ordered], [handle for _, (_, handle) in ordered]
        figure.legend(
            shown,
            labels,
            loc="outside lower center",
            ncols=min(3, len(labels)),
            fontsize=8,
            handlelength=2.4,
            columnspacing=1.2,
        )


def svg(figure: Figure) -> bytes:
    """The figure as SVG, the same bytes each time."""
    return _written(figure, "svg", metadata={"Date": None, "Creator": None})


def save(figure: Figure, path: Path) -> list[Path]:
    """Write `path`.png and `path`.svg, each complete or not at all."""
    written = {
        path.with_name(path.name + ".png"): _written(figure, "png"),
        path.with_name(path.name + ".svg"): svg(figure),
    }
    for file, data in written.items():
        files.replace(file, data)
    return list(written)


def _written(figure: Figure, kind: str, **options) -> bytes:
    image = io.BytesIO()
    with mpl.rc_context(LOOK):
        figure.savefig(image, format=kind, **options)
    return image.getvalue()
