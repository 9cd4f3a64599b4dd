"""Fig. 2 of the paper: mass is moved from one distribution to another, to the right and to the left.

The Wasserstein distance is the same both ways; the directional metric (Def. Wasserstein_like_metric) says which way.
"""

from statistics import NormalDist
from typing import Any, NamedTuple

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import FancyArrowPatch

from dgae_jax.export.pictures import COLOURS, PAPER
from dgae_jax.maths.transport import directional_metric, quantile_midpoints, wasserstein

LOWER, HIGHER = NormalDist(2.4, 0.55), NormalDist(5.4, 0.8)
"""The two distributions that are drawn; each is U in one column and V in the other."""

RANGE = (0.0, 8.6)
"""x_min and x_max."""

QUANTILES = 1000
"""Midpoints on which distances are computed."""

LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Shares of the mass at which the transfer plan is drawn."""


class Distances(NamedTuple):
    """What can be measured between two distributions U and V."""

    wasserstein: float
    """Of order 1."""
    forward: float
    """d(F_U, G_V), positive when U is superior."""
    backward: float
    """d(G_V, F_U)."""


def distances(u: NormalDist, v: NormalDist) -> Distances:
    """Between two normal distributions, on the quantile midpoints."""
    levels = [float(q) for q in quantile_midpoints(QUANTILES)]
    f, g = (jnp.array([one.inv_cdf(q) for q in levels]) for one in (u, v))
    return Distances(
        float(wasserstein(f, g)), float(directional_metric(f, g)), float(directional_metric(g, f))
    )


def figure() -> Figure:
    """Densities above, distribution functions below; (a) moves mass in the positive direction, (b) in the negative."""
    with matplotlib.rc_context(PAPER):
        sheet = Figure(figsize=(7.2, 4.0), layout=ConstrainedLayoutEngine(wspace=0.08))
        panels = sheet.subplots(
            2, 2, sharex=True, sharey="row", gridspec_kw={"height_ratios": [1.15, 1]}
        )
        for column, letter, (u, v) in zip(
            panels.T, "ab", ((LOWER, HIGHER), (HIGHER, LOWER)), strict=True
        ):
            _densities(column[0], u, v)
            _distribution_functions(column[1], u, v)
            column[1].set_xlabel("$x$", labelpad=-8)
            found = distances(u, v)
            column[0].set_title(
                f"({letter})  $d_1 = {found.wasserstein:.2f}$,   $d(F_U, G_V) = {_signed(found.forward)}$,"
                f"   $d(G_V, F_U) = {_signed(found.backward)}$",
                fontsize=10,
            )
        panels[0, 0].set_ylabel("density")
        panels[1, 0].set_ylabel("distribution function")
    return sheet


def _signed(x: float) -> str:
    return f"{x:+.2f}".replace("-", "{-}").replace("+", "{+}")


def _curves(u: NormalDist, v: NormalDist) -> tuple[tuple[NormalDist, str, str], ...]:
    return (u, "U", COLOURS["blue"]), (v, "V", COLOURS["orange"])


def _densities(axes: Any, u: NormalDist, v: NormalDist) -> None:
    x = np.linspace(*RANGE, 500)
    for one, name, colour in _curves(u, v):
        y = np.array([one.pdf(each) for each in x])
        axes.plot(x, y, color=colour, linewidth=1.5)
        axes.fill_between(x, y, color=colour, alpha=0.3, linewidth=0)
        axes.text(
            one.mean,
            0.4 * one.pdf(one.mean),
            f"${'f' if name == 'U' else 'g'}_{name}(x)$",
            ha="center",
            va="center",
        )
    top = max(one.pdf(one.mean) for one in (u, v))
    start, end = (u.mean, u.pdf(u.mean)), (v.mean, v.pdf(v.mean))
    axes.add_patch(_arrow(start, end, f"arc3,rad={0.35 if v.mean < u.mean else -0.35}", 14, 1.8))
    axes.text(
        (u.mean + v.mean) / 2, 1.14 * top, "transfer plan", ha="center", va="bottom", color=_PLAN
    )
    axes.set(ylim=(0, 1.32 * top), yticks=[])
    axes.spines[["top", "right"]].set_visible(False)


def _distribution_functions(axes: Any, u: NormalDist, v: NormalDist) -> None:
    x = np.linspace(*RANGE, 500)
    left = min(u, v, key=lambda one: one.mean)
    for one, name, colour in _curves(u, v):
        axes.plot(x, [one.cdf(each) for each in x], color=colour, linewidth=1.5)
        symbol, aside = (
            f"${'F' if name == 'U' else 'G'}_{name}(x)$",
            {"ha": "right"} if one is left else {"ha": "left"},
        )
        axes.text(
            one.inv_cdf(0.72) + (-0.2 if one is left else 0.2), 0.72, symbol, va="center", **aside
        )
    for q in LEVELS:
        axes.add_patch(_arrow((u.inv_cdf(q), q), (v.inv_cdf(q), q), "arc3", 9, 1.0))
    axes.set(ylim=(0, 1.1), xlim=(RANGE[0] - 0.3, RANGE[1] + 0.3), yticks=[0, 0.5, 1])
    axes.set_xticks(RANGE, [r"$x_{\min}$", r"$x_{\max}$"])
    axes.spines[["top", "right"]].set_visible(False)


_PLAN = "#8B3A6B"
"""Okabe and Ito's purple, darker, so that thin lines of it can be read on paper."""


def _arrow(
    start: tuple[float, float], end: tuple[float, float], style: str, head: float, width: float
) -> FancyArrowPatch:
    look: dict[str, Any] = {"color": _PLAN, "shrinkA": 1, "shrinkB": 1, "zorder": 3}
    return FancyArrowPatch(
        start,
        end,
        connectionstyle=style,
        arrowstyle="-|>",
        mutation_scale=head,
        linewidth=width,
        **look,
    )
