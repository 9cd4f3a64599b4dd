"""Learning curves."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure


def learning_curve(rows: list[dict[str, Any]], title: str) -> Figure:
    """Undiscounted episode return over samples: a thin line per run, mean and standard deviation when there are several."""
    seeds = sorted({row["seed"] for row in rows})
    steps = np.array([row["steps"] for row in rows if row["seed"] == seeds[0]]) if seeds else np.empty(0)
    runs = [np.array([row["episode_return"] for row in rows if row["seed"] == seed], float) for seed in seeds]
    figure = Figure(figsize=(6.4, 4.0), layout="constrained", dpi=150)
    axes = figure.subplots()
    several = len(runs) > 1
    for run in runs:
        axes.plot(steps, run, color="tab:blue", linewidth=0.8 if several else 1.5, alpha=0.4 if several else 1)
    if several:
        mean, std = np.mean(runs, 0), np.std(runs, 0)
        axes.plot(steps, mean, color="tab:blue", linewidth=2, label=f"mean of {len(runs)} seeds")
        axes.fill_between(steps, mean - std, mean + std, color="tab:blue", alpha=0.15, linewidth=0, label="± 1 standard deviation")
        axes.legend(loc="upper left", frameon=False)
    axes.set(title=title, xlabel="environment steps", ylabel="episode return while training")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.margins(x=0.01)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a PNG, in place at once or not at all."""
    part = path.with_name(path.name + ".part")
    figure.savefig(part, format="png")
    part.replace(path)
