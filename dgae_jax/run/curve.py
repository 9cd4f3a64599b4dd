"""Learning curves."""

import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from dgae_jax.run import files

POINTS = 1000
"""Most points of a line, about as many as the picture has columns: plotting takes the same time and memory in a long run."""


def learning_curve(
    steps: np.ndarray, returns: np.ndarray, title: str, evaluations: np.ndarray | None = None
) -> Figure:
    """Undiscounted episode returns [I, S] of S runs while training, over samples `steps` [I]; every so many if there are very many.

    A thin line per run, mean and standard deviation when there are several. `evaluations` [E, 3] are dots: samples, mean and
    standard deviation of the returns of the deterministic policy, one per run and evaluation.
    """
    figure = Figure(figsize=(6.4, 4.0), layout="constrained", dpi=150)
    axes = figure.subplots()
    several = returns.shape[1] > 1
    drawn = np.linspace(0, len(steps) - 1, min(len(steps), POINTS)).astype(int)
    steps, returns = steps[drawn], returns[drawn]
    for run in returns.T:
        label = None if several else "training"
        axes.plot(
            steps,
            run,
            color="tab:blue",
            linewidth=0.8 if several else 1.5,
            alpha=0.4 if several else 1,
            label=label,
        )
    if several:
        mean, std = returns.mean(1), returns.std(1)
        axes.plot(
            steps,
            mean,
            color="tab:blue",
            linewidth=2,
            label=f"training, mean of {returns.shape[1]} seeds",
        )
        axes.fill_between(
            steps,
            mean - std,
            mean + std,
            color="tab:blue",
            alpha=0.15,
            linewidth=0,
            label="± 1 standard deviation of seeds",
        )
    if evaluations is not None and len(evaluations):
        at, mean, std = evaluations.T
        axes.errorbar(
            at,
            mean,
            std,
            fmt="o",
            markersize=4,
            capsize=2,
            color="tab:orange",
            label="deterministic policy, mean ± std",
        )
    axes.legend(loc="upper left", frameon=False)
    axes.set(title=title, xlabel="environment steps", ylabel="episode return")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.margins(x=0.01)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a PNG, complete or not at all."""
    image = io.BytesIO()
    figure.savefig(image, format="png")
    files.replace(path, image.getvalue())
