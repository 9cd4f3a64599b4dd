"""Metrics as tidy JSON lines: one object per run and iteration."""

import contextlib
import itertools
import json
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.config import Config, ConfigError


class MetricsFile:
    """Appends to `metrics.jsonl`; `steps` counts the samples of one run, numbers that do not exist are null."""

    def __init__(self, path: Path, config: Config, done: int):
        """Keep the rows of the first `done` iterations; raises ConfigError if the file lacks any of them."""
        self.path, self.first_seed, self.samples, self.iteration = path, config.seed, config.samples, done
        self.rows = _first(path, done, config.num_seeds) if done else []
        part = path.with_suffix(".part")
        part.write_text("".join(json.dumps(row) + "\n" for row in self.rows))
        part.replace(path)

    @property
    def seconds(self) -> float:
        """Time of training in the rows so far."""
        return self.rows[-1]["seconds"] if self.rows else 0.0

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
        self.rows += rows
        return rows


def _first(path: Path, done: int, seeds: int) -> list[dict[str, Any]]:
    rows = []
    with contextlib.suppress(OSError, ValueError), path.open() as file:
        for line in itertools.islice(file, done * seeds):
            rows.append(json.loads(line))
    if [row.get("iteration") for row in rows if isinstance(row, dict)] != [i + 1 for i in range(done) for _ in range(seeds)]:
        raise ConfigError(f"{path}: must hold the {done:,} iterations of the checkpoint, one line per iteration and seed")
    return rows


def _number(x: float) -> float | int | None:
    if not math.isfinite(x):
        return None
    return int(x) if x == int(x) and abs(x) < 2**53 else float(f"{x:.7g}")


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a `metrics.jsonl`."""
    with path.open() as file:
        return [json.loads(line) for line in file]
