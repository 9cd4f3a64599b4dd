"""Draw the metrics of a healthy run: python benchmarks/metrics.py docs/images/metrics.jsonl

With a run directory behind it, `FILE.jsonl` is written first: at most 200 rows of the metrics of
one seed. The picture is `FILE.png`.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from tyro.conf import Positional

from dgae_jax.run import files, metrics

ROWS = 200
"""Most rows in the file."""

PANELS = (
    ("episode_return", "reward", "linear"),
    ("episode_length", "environment steps", "linear"),
    ("episodes", "episodes", "linear"),
    ("reward", "reward", "linear"),
    ("policy/loss", "1", "linear"),
    ("policy/kl", "nats", "linear"),
    ("policy/clip_fraction", "1", "linear"),
    ("policy/entropy", "nats", "linear"),
    ("critic/loss", "", "log"),
    ("critic/explained_variance", "1", "linear"),
    ("critic/value", "scaled return", "linear"),
    ("seconds", "s", "linear"),
)
"""Metric, unit, scale."""


def collect(run: Path, path: Path) -> None:
    """Write the rows that are drawn."""
    rows = metrics.read(run / "metrics.jsonl")
    own = [row for row in rows if row["seed"] == rows[0]["seed"]]
    files.replace(path, files.json_lines(own[:: -(-len(own) // ROWS)]))


def draw(path: Path) -> None:
    rows = metrics.read(path)
    steps = np.array([row["steps"] for row in rows])
    figure = Figure(figsize=(11, 6.6), layout="constrained", dpi=130)
    panels = zip(figure.subplots(3, 4, sharex=True).flat, PANELS, strict=True)
    for axes, (name, unit, scale) in panels:
        column = np.array([row[name] for row in rows], float)
        axes.plot(steps, column, color="tab:blue", linewidth=1.2)
        axes.set_title(f"{name} [{unit}]" if unit else name, fontsize=9)
        axes.set_yscale(scale)
        axes.tick_params(labelsize=8)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.margins(x=0.01)
    figure.supxlabel("environment steps", fontsize=9)
    metrics.save_figure(figure, path.with_suffix(".png"))


def main(file: Annotated[Path, Positional], run: Annotated[Path | None, Positional] = None) -> None:
    """Draw the metrics of a run.

    Args:
        file: metrics, one JSON object per line.
        run: run directory to take them from.
    """
    if run:
        collect(run, file)
    draw(file)


if __name__ == "__main__":
    tyro.cli(main)
