"""Metrics as tidy JSON lines: one object per run and iteration."""

import contextlib
import itertools
import math
import os
from array import array
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import files


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
        columns = {
            name: np.asarray(value, np.float64)[:count]
            for name, value in jax.device_get(metrics).items()
        }
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
