"""Metrics as tidy JSON lines: one object per run and iteration."""

import json
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np


class MetricsFile:
    """Appends to `metrics.jsonl`; `steps` counts the samples of one run, numbers that do not exist are null."""

    def __init__(self, path: Path, first_seed: int, samples: int):
        self.path, self.first_seed, self.samples = path, first_seed, samples
        self.iteration = 0
        path.touch()

    def append(self, metrics: dict[str, Any], count: int, seconds: float) -> list[dict[str, Any]]:
        """Write `count` iterations of metrics [capacity, S]; `seconds` is the time since training began."""
        columns = {name: np.asarray(value, np.float64)[:count] for name, value in jax.device_get(metrics).items()}
        rows = []
        for i in range(count):
            self.iteration += 1
            head = {"iteration": self.iteration, "steps": self.iteration * self.samples}
            for s in range(next(iter(columns.values())).shape[1]):
                numbers = {name: _number(column[i, s]) for name, column in columns.items()}
                rows.append({**head, "seed": self.first_seed + s, "seconds": round(seconds, 3), **numbers})
        with self.path.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
        return rows


def _number(x: float) -> float | int | None:
    if not math.isfinite(x):
        return None
    return int(x) if x == int(x) and abs(x) < 2**53 else float(f"{x:.7g}")


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a `metrics.jsonl`."""
    with path.open() as file:
        return [json.loads(line) for line in file]
