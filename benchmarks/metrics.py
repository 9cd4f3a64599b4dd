"""Draw what a healthy run looks like in its metrics: python benchmarks/metrics.py docs/images/metrics.jsonl

With a run directory behind it, `FILE.jsonl` is written first: every so many rows of one seed's `metrics.jsonl`, 200 at most. The
picture is `FILE.png`.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from dgae_jax.run import files, metrics

ROWS = 200
"""Most rows of the source of a picture."""

PANELS = (
    ("episode_return", "reward", "linear"), ("episode_length", "environment steps", "linear"), ("episodes", "episodes", "linear"),
    ("reward", "reward", "linear"),
    ("policy/loss", "1", "linear"), ("policy/kl", "nats", "linear"), ("policy/clip_fraction", "1", "linear"),
    ("policy/entropy", "nats", "linear"),
    ("critic/loss", "", "log"), ("critic/explained_variance", "1", "linear"), ("critic/value", "scaled return", "linear"),
    ("seconds", "s", "linear"),
)  # fmt: skip
"""Metric, unit, scale."""


def collect(run: Path, path: Path) -> None:
    """Take from a run what is drawn."""
    rows = metrics.read(run / "metrics.jsonl")
    own = [row for row in rows if row["seed"] == rows[0]["seed"]]
    files.replace(path, files.json_lines(own[:: -(-len(own) // ROWS)]))


def draw(path: Path) -> None:
    rows = metrics.read(path)
    steps = np.array([row["steps"] for row in rows])
    figure = Figure(figsize=(11, 6.6), layout="constrained", dpi=130)
    for axes, (name, unit, scale) in zip(
        figure.subplots(3, 4, sharex=True).flat, PANELS, strict=True
    ):
        axes.plot(
            steps, np.array([row[name] for row in rows], float), color="tab:blue", linewidth=1.2
        )
        axes.set_title(f"{name} [{unit}]" if unit else name, fontsize=9)
        axes.set_yscale(scale)
        axes.tick_params(labelsize=8)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.margins(x=0.01)
    figure.supxlabel("environment steps", fontsize=9)
    metrics.save_figure(figure, path.with_suffix(".png"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("run", type=Path, nargs="?")
    arguments = parser.parse_args()
    if arguments.run:
        collect(arguments.run, arguments.file)
    draw(arguments.file)
