"""Metrics as tidy JSON lines: one object per run and iteration."""

import contextlib
import io
import itertools
import math
import os
from array import array
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import files

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class MetricsFile:
    """Appends to `metrics.jsonl`; `steps` counts the samples of one run, numbers that do not exist are null.

    Of the rows it keeps only the episode returns and how many had an update left out, so that a long run does not fill the memory.
    """

    def __init__(self, path: Path, config: ResolvedConfig, done: int):
        """Keep the rows of the first `done` iterations; raises ConfigError if the file lacks any of them."""
        self.path, self.first_seed, self.seeds, self.samples = (
            path,
            config.seed,
            config.num_seeds,
            config.samples_per_iteration,
        )
        self.iteration, self.seconds, self.skipped = 0, 0.0, 0
        self.returns = array("d")
        """Episode returns of the rows so far, NaN where there was none."""
        end = 0
        with contextlib.suppress(
            FileNotFoundError, LookupError, TypeError, ValueError, OverflowError
        ):
            for row, behind in itertools.islice(files.whole_rows(path), done * self.seeds):
                iteration, seed = divmod(len(self.returns), self.seeds)
                if (row["iteration"], row["seed"]) != (
                    iteration + 1,
                    config.seed + seed,
                ) or not 0 <= row["seconds"] < math.inf:
                    break
                self._take(row)
                end = behind
        if len(self.returns) != done * self.seeds:
            raise ConfigError(
                f"{path}: must hold the {done:,} iterations of the checkpoint, one line per iteration and seed"
            )
        path.touch()
        os.truncate(path, end)

    def _take(self, row: dict[str, Any]) -> None:
        value = row["episode_return"]
        self.iteration, self.seconds = row["iteration"], float(row["seconds"])
        self.returns.append(math.nan if value is None else value)
        self.skipped += bool(row.get("skipped"))

    def append(self, metrics: dict[str, Any], count: int, seconds: float) -> list[dict[str, Any]]:
        """Write `count` iterations of metrics [capacity, S]; `seconds` is the time since training began."""
        columns = {name: np.asarray(value, np.float64)[:count] for name, value in metrics.items()}
        rows = []
        for i in range(count):
            head = {
                "iteration": self.iteration + i + 1,
                "steps": (self.iteration + i + 1) * self.samples,
            }
            for s in range(self.seeds):
                numbers = {name: _number(column[i, s]) for name, column in columns.items()}
                rows.append(
                    {**head, "seed": self.first_seed + s, "seconds": round(seconds, 3), **numbers}
                )
        files.append_rows(self.path, rows)
        for row in rows:
            self._take(row)
        return rows

    def curve(self) -> tuple[np.ndarray, np.ndarray]:
        """Samples [I] and episode returns [I, S] of every iteration so far."""
        returns = np.array(self.returns).reshape(-1, self.seeds)
        return self.samples * np.arange(1, len(returns) + 1), returns


def _number(x: float) -> float | int | None:
    if not math.isfinite(x):
        return None
    return int(x) if x == int(x) and abs(x) < 2**53 else float(f"{x:.7g}")


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a `metrics.jsonl`, or any other file of JSON lines, up to a line that is torn."""
    return [row for row, _ in files.whole_rows(path)]


class EvaluationsFile:
    """One row per run and evaluation."""

    def __init__(self, path: Path):
        self.path = path
        self.rows: list[dict[str, Any]] = []
        with contextlib.suppress(OSError):
            self.rows = [row for row, _ in files.whole_rows(path) if _is_evaluation(row)]

    def cut(self, steps: int, runs: int) -> None:
        """Forget what followed the first `steps` samples, and evaluations that lack some of the `runs`."""
        rows_at = Counter(row["steps"] for row in self.rows)
        self.rows = [
            row for row in self.rows if row["steps"] <= steps and rows_at[row["steps"]] == runs
        ]
        files.replace(self.path, files.json_lines(self.rows))

    def has(self, steps: int) -> bool:
        """Whether the state after `steps` samples was evaluated."""
        return any(row["steps"] == steps for row in self.rows)

    def append(self, steps: int, result: dict[str, Any]) -> None:
        """Note an evaluation after `steps` samples; returns that are not finite are written, and count for nothing."""
        rows = [
            {
                "steps": steps,
                **{k: one[k] for k in ("seed", "return_mean", "return_std", "returns")},
            }
            for one in result["seeds"]
        ]
        files.append_rows(self.path, rows)
        self.rows += [row for row in rows if _is_evaluation(row)]

    def points(self) -> np.ndarray:
        """Steps, mean and standard deviation of every row [E, 3]."""
        return np.array(
            [[row[name] for name in ("steps", "return_mean", "return_std")] for row in self.rows]
        ).reshape(-1, 3)

    @property
    def best(self) -> int | None:
        """Steps of the best evaluation, by the mean over all runs, of those in which none of them is missing; the later of equal ones."""
        steps, mean, _ = self.points().T
        runs = Counter(steps)
        whole = [int(at) for at in runs if runs[at] == max(runs.values())]
        return max(whole, key=lambda at: (mean[steps == at].mean(), at), default=None)


def _is_evaluation(row: dict[str, Any]) -> bool:
    """A file may hold anything."""
    steps, *numbers = (row.get(name) for name in ("steps", "seed", "return_mean", "return_std"))
    if not (
        type(steps) is int
        and 0 <= steps < 2**53
        and all(isinstance(x, float | int) and abs(x) < 1e30 for x in numbers)
    ):
        return False
    return row["return_std"] >= 0


POINTS = 1000
"""Most points of a line, about as many as the picture has columns: plotting takes the same time and memory in a long run."""


def learning_curve(
    steps: np.ndarray, returns: np.ndarray, title: str, evaluations: np.ndarray | None = None
) -> "Figure":
    """Undiscounted episode returns [I, S] of S runs while training, over samples `steps` [I]; every so many if there are very many.

    A thin line per run, mean and standard deviation when there are several. `evaluations` [E, 3] are dots: samples, mean and
    standard deviation of the returns of the deterministic policy, one per run and evaluation.
    """
    from matplotlib.figure import Figure  # takes a second to load, for which training does not wait
    from matplotlib.ticker import EngFormatter

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


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a PNG, complete or not at all."""
    image = io.BytesIO()
    figure.savefig(image, format="png")
    files.replace(path, image.getvalue())
