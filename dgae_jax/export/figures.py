"""Figures of the paper that need no training."""

from pathlib import Path
from statistics import NormalDist
from typing import Any

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import FancyArrowPatch

from dgae_jax.maths.transport import directional_metric, quantile_midpoints, wasserstein
from dgae_jax.run import metrics

COLORS = {
    "black": "#000000",
    "orange": "#E69F00",
    "sky": "#56B4E9",
    "blue": "#0072B2",
    "vermilion": "#D55E00",
    "plan": "#8B3A6B",
}
"""Okabe and Ito (2008), for readers with any color vision; `plan` is a darker purple."""

STYLE = Path(__file__).parent / "templates" / "paper.mplstyle"

POSES = {
    "ant": (0, 0, 0.62, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1),
    "hopper": (0, 1.1, 0.12, -0.3, -0.55, 0.25),
    "swimmer": (0, 0, 0.35, -0.9, 0.9),
    "walker2d": (0, 1.22, 0.05, -0.55, -0.35, 0.2, 0.15, -0.6, 0.1),
}
"""Positions that show each robot's shape (m, rad; a quaternion for the ant)."""

LOWER, HIGHER = NormalDist(2.4, 0.55), NormalDist(5.4, 0.8)
"""The distributions of Fig. 2; each is U in one column and V in the other."""

RANGE = (0.0, 8.6)
"""x_min and x_max."""

LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Probabilities at which the transfer plan is drawn."""


def save(figure: Figure, path: Path) -> None:
    """Write a PNG or an SVG, by the suffix of `path`, complete or not at all."""
    with matplotlib.rc_context(fname=STYLE):
        metrics.save_figure(figure, path)


def robots() -> Figure:
    """Draw Fig. 1: the four robots, in panels (a) to (d)."""
    from dgae_jax.export.renderer import Renderer  # here, as it needs OpenGL

    with matplotlib.rc_context(fname=STYLE):
        figure = Figure(figsize=(7.2, 2.1), layout="constrained")
        panels = zip(figure.subplots(1, 4), "abcd", POSES.items(), strict=True)
        for axes, letter, (env, pose) in panels:
            with Renderer(env, None, 640, 640) as renderer:
                axes.imshow(renderer.draw(np.array(pose)))
            axes.set(xticks=[], yticks=[])
            axes.set_xlabel(f"({letter}) {env.capitalize()}", labelpad=4)
            axes.spines[:].set(linewidth=0.5, color="0.6")
    return figure


def distances(u: NormalDist, v: NormalDist) -> list[float]:
    """Return the Wasserstein distance, d(F_U, G_V) and d(G_V, F_U) on the quantile midpoints."""
    levels = [float(q) for q in quantile_midpoints(1000)]
    f, g = (jnp.array([one.inv_cdf(q) for q in levels]) for one in (u, v))
    return list(map(float, (wasserstein(f, g), directional_metric(f, g), directional_metric(g, f))))


def transport() -> Figure:
    """Draw Fig. 2: mass is moved (a) in the positive direction, (b) in the negative.

    The Wasserstein distance is the same both ways; the directional metric tells them apart.
    """
    with matplotlib.rc_context(fname=STYLE):
        figure = Figure(figsize=(7.2, 4.0), layout=ConstrainedLayoutEngine(wspace=0.08))
        panels = figure.subplots(
            2, 2, sharex=True, sharey="row", gridspec_kw={"height_ratios": [1.15, 1]}
        )
        pairs = ((LOWER, HIGHER), (HIGHER, LOWER))
        for (upper, lower), letter, (u, v) in zip(panels.T, "ab", pairs, strict=True):
            _densities(upper, u, v)
            _distribution_functions(lower, u, v)
            lower.set_xlabel("$x$", labelpad=-8)
            d, forward, backward = distances(u, v)
            signed = f"$d(F_U, G_V) = {forward:+.2f}$,   $d(G_V, F_U) = {backward:+.2f}$"
            upper.set_title(f"({letter})  $d_1 = {d:.2f}$,   {signed}", fontsize=10)
        panels[0, 0].set_ylabel("density")
        panels[1, 0].set_ylabel("distribution function")
    return figure


_X = np.linspace(*RANGE, 500)


def _densities(axes: Any, u: NormalDist, v: NormalDist) -> None:
    for one, name, color in ((u, "f_U", "blue"), (v, "g_V", "orange")):
        y = np.array([one.pdf(x) for x in _X])
        axes.plot(_X, y, color=COLORS[color], linewidth=1.5)
        axes.fill_between(_X, y, color=COLORS[color], alpha=0.3, linewidth=0)
        axes.text(one.mean, 0.4 * one.pdf(one.mean), f"${name}(x)$", ha="center", va="center")
    top = max(one.pdf(one.mean) for one in (u, v))
    start, end = ((one.mean, one.pdf(one.mean)) for one in (u, v))
    axes.add_patch(_arrow(start, end, f"arc3,rad={0.35 if v.mean < u.mean else -0.35}", 14, 1.8))
    middle = {"ha": "center", "va": "bottom", "color": COLORS["plan"]}
    axes.text((u.mean + v.mean) / 2, 1.14 * top, "transfer plan", **middle)
    axes.set(ylim=(0, 1.32 * top), yticks=[])
    axes.spines[["top", "right"]].set_visible(False)


def _distribution_functions(axes: Any, u: NormalDist, v: NormalDist) -> None:
    for one, other, name, color in ((u, v, "F_U", "blue"), (v, u, "G_V", "orange")):
        axes.plot(_X, [one.cdf(x) for x in _X], color=COLORS[color], linewidth=1.5)
        side, shift = ("right", -0.2) if one.mean < other.mean else ("left", 0.2)
        axes.text(one.inv_cdf(0.72) + shift, 0.72, f"${name}(x)$", va="center", ha=side)
    for q in LEVELS:
        axes.add_patch(_arrow((u.inv_cdf(q), q), (v.inv_cdf(q), q), "arc3", 9, 1.0))
    axes.set(ylim=(0, 1.1), xlim=(RANGE[0] - 0.3, RANGE[1] + 0.3), yticks=[0, 0.5, 1])
    axes.set_xticks(RANGE, [r"$x_{\min}$", r"$x_{\max}$"])
    axes.spines[["top", "right"]].set_visible(False)


def _arrow(start: Any, end: Any, curve: str, head: float, width: float) -> FancyArrowPatch:
    style: Any = {"color": COLORS["plan"], "linewidth": width, "zorder": 3}
    shape: Any = {"connectionstyle": curve, "arrowstyle": "-|>", "mutation_scale": head}
    return FancyArrowPatch(start, end, shrinkA=1, shrinkB=1, **shape, **style)
