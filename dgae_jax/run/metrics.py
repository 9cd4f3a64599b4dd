"""Metrics and evaluations as JSON lines, and the learning curve. Imports neither JAX nor pyplot."""

import io
import itertools
import math
import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import files

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def read(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a `metrics.jsonl` up to a damaged line."""
    return [row for row, _ in files.whole_rows(path)]


class MetricsFile:
    """`metrics.jsonl`: one row per iteration and seed; `steps` counts the samples of one run.

    Only episode returns and the number of skipped updates stay in memory.
    """

    def __init__(self, path: Path, config: ResolvedConfig, done: int):
        """Keep the rows of the first `done` iterations, which it must have; cut off the rest."""
        self.path, self.first_seed, self.seeds = path, config.seed, config.num_seeds
        self.samples = config.samples_per_iteration
        self.iteration, self.seconds, self.skipped = 0, 0.0, 0
        self.returns: list[float] = []
        """Episode returns of the rows so far, NaN where there was none."""
        path.touch()
        rows = list(itertools.islice(files.whole_rows(path), done * self.seeds))
        if len(rows) != done * self.seeds:
            must = f"must hold the {done:,} iterations of the checkpoint, one row per seed"
            raise ConfigError(f"{path}: {must}")
        os.truncate(path, rows[-1][1] if rows else 0)
        for row, _ in rows:
            self._count(row)

    def _count(self, row: dict[str, Any]) -> None:
        value = row["episode_return"]
        self.iteration, self.seconds = row["iteration"], row["seconds"]
        self.returns.append(math.nan if value is None else value)
        self.skipped += bool(row.get("skipped"))

    def append(self, metrics: dict[str, Any], count: int, seconds: float) -> list[dict[str, Any]]:
        """Append `count` iterations of metrics [capacity, S]; `seconds` counts from the start."""
        columns = {name: np.asarray(x, np.float64)[:count] for name, x in metrics.items()}
        rows = []
        for i, s in itertools.product(range(count), range(self.seeds)):
            iteration = self.iteration + i + 1
            head = {"iteration": iteration, "steps": iteration * self.samples}
            head |= {"seed": self.first_seed + s, "seconds": round(seconds, 3)}
            rows.append({**head, **{name: _number(x[i, s]) for name, x in columns.items()}})
        files.append_rows(self.path, rows)
        for row in rows:
            self._count(row)
        return rows

    def curve(self) -> tuple[np.ndarray, np.ndarray]:
        """Return samples [I] and episode returns [I, S] of every iteration so far."""
        returns = np.array(self.returns).reshape(-1, self.seeds)
        return self.samples * np.arange(1, len(returns) + 1), returns


def _number(x: float) -> float | int | None:
    if not math.isfinite(x):
        return None
    return int(x) if x == int(x) and abs(x) < 2**53 else float(f"{x:.7g}")


class EvaluationsFile:
    """`evaluations.jsonl`: one row per seed and periodic evaluation."""

    def __init__(self, path: Path):
        """Read the rows that are there; returns that are not finite do not count."""
        self.path = path
        found = read(path) if path.exists() else []
        self.rows = [row for row in found if row.get("return_mean") is not None]

    def cut(self, steps: int, seeds: int) -> None:
        """Remove what followed the first `steps` samples, and evaluations that lack a seed."""
        rows_at = Counter(row["steps"] for row in self.rows)
        whole = {at for at, count in rows_at.items() if at <= steps and count == seeds}
        self.rows = [row for row in self.rows if row["steps"] in whole]
        files.replace(self.path, files.json_lines(self.rows))

    def has(self, steps: int) -> bool:
        """Return whether the state after `steps` samples was evaluated."""
        return any(row["steps"] == steps for row in self.rows)

    def append(self, steps: int, result: dict[str, Any]) -> list[dict[str, Any]]:
        """Append an evaluation after `steps` samples; return its rows."""
        kept = "seed", "return_mean", "return_std", "returns"
        rows = [{"steps": steps, **{k: one[k] for k in kept}} for one in result["seeds"]]
        files.append_rows(self.path, rows)
        self.rows = EvaluationsFile(self.path).rows
        return [row for row in self.rows if row["steps"] == steps]

    def points(self) -> np.ndarray:
        """Return steps, mean and standard deviation of every row [E, 3]."""
        names = "steps", "return_mean", "return_std"
        return np.array([[row[name] for name in names] for row in self.rows]).reshape(-1, 3)

    @property
    def best(self) -> int | None:
        """Steps of the evaluation with the best mean over all seeds; the later of equal ones."""
        steps, mean, _ = self.points().T
        seeds = Counter(steps)
        whole = [int(at) for at in seeds if seeds[at] == max(seeds.values())]
        return max(whole, key=lambda at: (mean[steps == at].mean(), at), default=None)


def learning_curve(
    steps: np.ndarray, returns: np.ndarray, title: str, evaluations: np.ndarray | None = None
) -> "Figure":
    """Plot undiscounted episode returns [I, S] of S seeds over samples [I].

    `evaluations` [E, 3] are samples, mean and std of the deterministic policy's returns.
    """
    from matplotlib.figure import Figure  # takes a second, for which training does not wait
    from matplotlib.ticker import EngFormatter

    axes = Figure(figsize=(6.4, 4.0), layout="constrained", dpi=150).subplots()
    mean, std, seeds, label = returns.mean(1), returns.std(1), returns.shape[1], "training"
    blue: dict[str, Any] = {"color": "tab:blue"}
    if seeds > 1:
        axes.plot(steps, returns, linewidth=0.8, alpha=0.4, **blue)
        shade: dict[str, Any] = {"alpha": 0.15, "linewidth": 0, "label": "± std over seeds"}
        axes.fill_between(steps, mean - std, mean + std, **shade, **blue)
        label = f"training, mean of {seeds} seeds"
    axes.plot(steps, mean, linewidth=1.5, label=label, **blue)
    if evaluations is not None and len(evaluations):
        dots: dict[str, Any] = {"fmt": "o", "markersize": 4, "capsize": 2, "color": "tab:orange"}
        axes.errorbar(*evaluations.T, label="deterministic policy, mean ± std", **dots)
    axes.legend(loc="upper left", frameon=False)
    axes.set(title=title, xlabel="environment steps", ylabel="episode return")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.margins(x=0.01)
    return axes.figure  # pyright: ignore[reportReturnType]


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a PNG or an SVG, by the suffix, atomically."""
    image = io.BytesIO()
    figure.savefig(image, format=path.suffix[1:], metadata={"Date": None})
    files.replace(path, image.getvalue())
