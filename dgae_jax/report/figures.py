"""Figures of a report: one look per algorithm, white paper, readable alone."""

import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.parts import CRITICS
from dgae_jax.report import analysis
from dgae_jax.report.analysis import Estimate, Improvement
from dgae_jax.report.groups import Group, by_task
from dgae_jax.report.results import Published

PANEL = (4.5, 3.3)
"""Size of a panel [inches]: its text is legible on a phone, where a panel fills the width."""

# colours of Okabe and Ito, told apart with any colour vision
COLOURS = {"clip": "#0072B2", "trust-region": "#D55E00", "gradient": "#009E73"}
"""Colours of the policy updates."""
CUSTOM, PUBLISHED, FAINT = "#56B4E9", "#CC79A7", "#777777"

MARKERS = ("", "o", "s", "^", "D", "v", "P", "X")
"""Markers that tell apart groups of the same colour and line."""

STYLE = Path(__file__).parent / "templates" / "figures.mplstyle"


def look(algo: str, number: int = 0) -> dict[str, Any]:
    """Return Matplotlib's properties of a group's line, by its algorithm and its number.

    The colour is that of the policy update. A scalar critic has dashes and hollow markers.
    """

    def kind(name: str) -> tuple[str, bool]:
        return ALGORITHMS[name].policy_update, "quantiles" in CRITICS[ALGORITHMS[name].critic]

    update, distribution = kind(algo)
    alike = [name for name in ALGORITHMS if kind(name) == (update, distribution)]
    style = {"color": COLOURS.get(update, CUSTOM), "linestyle": "-" if distribution else "--"}
    style["marker"] = MARKERS[(number + alike.index(algo)) % len(MARKERS)]
    return style | {"markerfacecolor": style["color"] if distribution else "white"}


def learning_curves(groups: Iterable[Group], published: Sequence[Published] = ()) -> Figure:
    """Draw the return during training per task: mean over seeds ± one standard deviation.

    Crosses are published results, up to the number of samples of the groups.
    """

    def draw(axes: Axes, members: Sequence[Group]) -> None:
        for group in members:
            steps, curve = group.curve
            if curve.size:
                mean, std = curve.mean(0), curve.std(0, ddof=min(1, len(curve) - 1))
                _line(axes, group, steps, mean, (mean - std, mean + std), markevery=0.1)
        _crosses(axes, members, published)
        axes.set(xlabel="environment steps", ylabel="episode return")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))

    return _panels(by_task(groups), draw, PANEL[1])


def _line(
    axes: Axes, group: Group, x: np.ndarray, y: np.ndarray, ends: Any, markevery: float
) -> None:
    style = look(group.algo, group.number)
    axes.plot(x, y, label=group.name, markevery=markevery, markersize=4, **style)
    if ends is not None:
        axes.fill_between(x, *ends, color=style["color"], alpha=0.12, linewidth=0)


def _crosses(axes: Axes, members: Sequence[Group], published: Sequence[Published]) -> None:
    end = max(row.total_steps for group in members for row in group.rows)
    env = members[0].rows[0].env
    known = [one for one in published if one.task == env and one.samples <= end]
    for number, one in enumerate(known, start=1):
        algo = one.algorithm.lower()
        colour = look(algo)["color"] if algo in ALGORITHMS else PUBLISHED
        at = one.samples + number * 0.015 * end  # a little to the right, beside each other
        style = {"fmt": "x", "markersize": 5, "capsize": 2, "linewidth": 1, "color": colour}
        axes.errorbar(at, one.mean, one.spread, label=f"{one.algorithm}, published", **style)


def final_returns(groups: Iterable[Group]) -> Figure:
    """Draw the interquartile mean of the final returns with its interval, and each seed."""

    def draw(axes: Axes, members: Sequence[Group]) -> None:
        finals = [group.finals for group in members]
        _dots(axes, members, [analysis.interquartile_mean(scores) for scores in finals], finals)
        axes.set_xlabel("return of the final policy")

    tasks = by_task(groups)
    return _panels(tasks, draw, 0.9 + 0.28 * max(map(len, tasks.values())))


def improvement(found: Sequence[Improvement]) -> Figure:
    """Draw the probability of improvement per task and pair of algorithms."""

    def draw(axes: Axes, duels: Sequence[Improvement]) -> None:
        names = [f"{duel.better.name} > {duel.worse.name}\n{duel.task}" for duel in duels]
        none, estimates = [np.empty(0)] * len(duels), [duel.estimate for duel in duels]
        _dots(axes, [duel.better for duel in duels], estimates, none)
        axes.set_yticks(range(len(duels)), names)
        axes.axvline(0.5, color=FAINT, linewidth=1)
        axes.set(xlabel="probability of improvement", xlim=(-0.03, 1.03))
        axes.xaxis.set_major_formatter(PercentFormatter(1))

    return _panels({"Distributional against scalar": found}, draw, 0.9 + 0.4 * len(found))


def performance_profile(groups: Iterable[Group]) -> Figure:
    """Draw the share of runs above each normalised score, with its interval."""

    def draw(axes: Axes, scores: Mapping[str, tuple[Group, list[np.ndarray]]]) -> None:
        top = max((s.max() for _, strata in scores.values() for s in strata), default=1.0)
        taus = np.linspace(0, 1.05 * top, 200)
        for group, strata in scores.values():
            ends = analysis.interval(lambda s: analysis.performance_profile(s, taus), strata)
            shares = analysis.performance_profile(strata, taus)
            _line(axes, group, taus, shares, ends, markevery=20)
        axes.set(xlabel="normalised score τ", ylabel="share of runs above τ", ylim=(-0.02, 1.02))
        axes.yaxis.set_major_formatter(PercentFormatter(1))

    scores = analysis.normalised(groups)
    return _panels({"Performance profile": scores}, draw, PANEL[1])


def coverage(statistics: Mapping[str, Any]) -> str:
    """Describe how many returns a critic's central 90 % interval holds (`run.calibration`)."""
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

    def draw(axes: Axes, critic: tuple[str, dict[str, Any]]) -> None:
        algo, shares = critic[0], np.array(critic[1]["pit"])
        edges = np.linspace(0, 1, len(shares) + 1)
        style = {"color": look(algo)["color"], "edgecolor": "white", "linewidth": 0.5}
        axes.bar(edges[:-1], shares, np.diff(edges), align="edge", **style)
        axes.axhline(1 / len(shares), color=FAINT, linestyle=":", label="calibrated")
        axes.set(xlabel="share of the quantiles below the observed return", ylabel="returns")
        axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))

    titled = {f"{name}\n{coverage(critic[1])}": critic for name, critic in found.items()}
    return _panels(titled, draw, PANEL[1], columns=3, sharey=True)


def _dots(
    axes: Axes, groups: Sequence[Group], estimates: Sequence[Estimate], seeds: Sequence[np.ndarray]
) -> None:
    """Draw rows from top to bottom: ticks of the seeds, the interval, the value."""
    for y, (group, estimate, dots) in enumerate(zip(groups, estimates, seeds, strict=True)):
        style = look(group.algo, group.number)
        faint = {"color": style["color"], "alpha": 0.6}
        axes.plot(dots, np.full(len(dots), y), "|", markersize=7, **faint)
        if estimate.interval is not None:
            axes.plot(estimate.interval, [y, y], linewidth=2.2, **faint)
        style["marker"] = style["marker"] or "o"
        axes.plot(estimate.value, y, markersize=6, **style)
    axes.set_yticks(range(len(groups)), [group.name for group in groups])
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)


def _panels(
    contents: Mapping[str, Any],
    draw: Callable[[Axes, Any], None],
    height: float,
    *,
    columns: int = 2,
    sharey: bool = False,
) -> Figure:
    """Draw a panel per content, with its title, and one legend for all."""
    columns = min(columns, len(contents))
    rows = -(-len(contents) // columns)
    with mpl.rc_context(fname=STYLE):
        figure = Figure(layout="constrained", dpi=150)
        panels = list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).flat)
        for axes, (title, content) in zip(panels, contents.items(), strict=False):
            draw(axes, content)
            axes.set_title(title)
        for axes in panels[len(contents) :]:
            axes.remove()
        handles: dict[str, Any] = {}
        for axes in figure.axes:
            found, labels = axes.get_legend_handles_labels()
            handles |= dict(zip(labels, found, strict=True))
        if handles:  # the two algorithms of a pair share a column
            place: Any = {"loc": "outside lower center", "ncols": min(3, len(handles))}
            figure.legend(handles.values(), handles, fontsize=8, handlelength=2.4, **place)
        figure.set_size_inches(columns * PANEL[0], rows * height + 0.5 * bool(handles))
    return figure


def image(figure: Figure, kind: str) -> bytes:
    """Return the figure as png or svg, the same bytes each time."""
    file = io.BytesIO()
    with mpl.rc_context(fname=STYLE):
        figure.savefig(file, format=kind, metadata={"Date": None, "Creator": None})
    return file.getvalue()
