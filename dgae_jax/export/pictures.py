"""What the pictures share: colours that the colour-blind can tell apart, fonts of a paper, files."""

import io
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from dgae_jax.run import files

COLOURS = {
    "black": "#000000",
    "orange": "#E69F00",
    "sky": "#56B4E9",
    "green": "#009E73",
    "yellow": "#F0E442",
    "blue": "#0072B2",
    "vermilion": "#D55E00",
    "purple": "#CC79A7",
}
"""Okabe and Ito (2008)."""

PAPER: Any = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 10,
    "axes.linewidth": 0.8,
    "svg.hashsalt": "dgae_jax",
}
"""Matplotlib's settings for a picture in a paper; an SVG has the same bytes each time."""

_UNDATED = {"svg": {"Date": None}, "png": {"Software": None}}


def save(figure: Figure, path: Path, dpi: int = 200) -> None:
    """Write a PNG or an SVG, as the name of the file ends, complete or not at all. Raises OSError if it cannot be written."""
    image, kind = io.BytesIO(), path.suffix[1:]
    with matplotlib.rc_context(PAPER):
        figure.savefig(
            image,
            format=kind,
            dpi=dpi,
            metadata=_UNDATED[kind],
            bbox_inches="tight",
            pad_inches=0.03,
        )
    files.replace(path, image.getvalue())
