"""`evaluations.jsonl`: what the policies of a run were worth at each of its checkpoints."""

import contextlib
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dgae_jax.run import files


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
