"""Calibration of critics: histograms of the probability integral transform."""

import math
from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from dgae_jax.report.figures import LOOK, PANEL
from dgae_jax.report.style import FAINT, look


def held(statistics: Mapping[str, Any]) -> str:
    """How many of the returns the critic's central 90 % hold, in words."""
    share = statistics["coverage_90"]
    if math.isnan(share):
        return "fewer than 10 quantiles have no central 90 %"
    return f"{100 * share:.0f} % of the returns in the central 90 %"


def histograms(found: Mapping[str, tuple[str, dict[str, Any]]]) -> Figure:
    """A panel per critic, its algorithm and its statistics (`run.calibration`) by its name: flat is calibrated, a U too narrow."""
    with mpl.rc_context(LOOK):
        columns = min(3, len(found))
        rows = -(-len(found) // columns)
        figure = Figure(
            figsize=(PANEL[0] * columns, PANEL[1] * rows), layout="constrained", dpi=150
        )
        panels = np.atleast_1d(figure.subplots(rows, columns, sharey=True)).ravel()
        for axes in panels[len(found) :]:
            axes.remove()
        for axes, (name, (algo, statistics)) in zip(panels, found.items(), strict=False):
            shares = np.array(statistics["pit"])
            edges = np.linspace(0, 1, len(shares) + 1)
            axes.bar(
                edges[:-1],
                shares,
                np.diff(edges),
                align="edge",
                color=look(algo).colour,
                edgecolor="white",
                linewidth=0.5,
            )
            axes.axhline(1 / len(shares), color=FAINT, linestyle=":", label="calibrated")
            title = f"{name}\n{held(statistics)}"
            axes.set(
                title=title,
                xlabel="share of the quantiles below the return that came",
                ylabel="returns",
            )
            axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        panels[0].legend()
    return figure
