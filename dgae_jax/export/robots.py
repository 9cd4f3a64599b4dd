"""Fig. 1 of the paper: the four robots."""

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from dgae_jax.export.pictures import PAPER
from dgae_jax.export.stage import Stage

NAMES = {"ant": "Ant", "hopper": "Hopper", "swimmer": "Swimmer", "walker2d": "Walker2d"}
"""In the order of the paper."""

POSES = {
    "ant": (0, 0, 0.62, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1),
    "hopper": (0, 1.1, 0.12, -0.3, -0.55, 0.25),
    "swimmer": (0, 0, 0.35, -0.9, 0.9),
    "walker2d": (0, 1.22, 0.05, -0.55, -0.35, 0.2, 0.15, -0.6, 0.1),
}
"""Positions in which the shape of each is seen (m, rad; a quaternion for the ant)."""

PIXELS = (640, 640)
"""Width and height of each panel."""


def figure() -> Figure:
    """Four panels, (a) to (d), each with the name of its robot below."""
    with matplotlib.rc_context(PAPER):
        sheet = Figure(figsize=(7.2, 2.1), layout="constrained")
        for axes, letter, (env, name) in zip(
            sheet.subplots(1, 4), "abcd", NAMES.items(), strict=True
        ):
            axes.imshow(_panel(env))
            axes.set(xticks=[], yticks=[])
            axes.set_xlabel(f"({letter}) {name}", labelpad=4)
            axes.spines[:].set(linewidth=0.5, color="0.6")
    return sheet


def _panel(env: str) -> np.ndarray:
    width, height = PIXELS
    with Stage(env, None, width=width, height=height) as stage:
        return stage.picture(np.array(POSES[env], float))
