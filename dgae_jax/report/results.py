"""Results of a sweep: one row per trained seed, read strictly from `results.jsonl`."""

import csv
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.serial import upgraded
from dgae_jax.run import files, terminal

RESULTS = "results.jsonl"


@dataclass(frozen=True)
class Row:
    """One trained seed."""

    run: str
    env: str
    env_version: str | None
    algo: str
    variant: str | None
    """Name of the variant in an ablation; None in a comparison of algorithms."""
    seed: int
    total_steps: int
    engine: str
    final: float
    """Mean return of the final policy in `engine`."""
    returns: np.ndarray
    """Returns [E] of the final policy's episodes."""
    best: float | None
    """Mean return of the best checkpoint; None without evaluations during training."""
    curve_steps: np.ndarray
    """Samples [I], increasing."""
    curve_returns: np.ndarray
    """Undiscounted episode returns [I] during training; NaN before the first episode ends."""
    seconds: float
    samples_per_second: float
    config: dict
    """The configuration in today's names, without its schema."""
    versions: dict
    machine: dict
    git_revision: str | None
    command: str

    @property
    def task(self) -> str:
        """The env with its version, if it has one, and whether it is noisy."""
        noise = " with noise" if any((self.config.get("noise") or {}).values()) else ""
        return (f"{self.env}-{self.env_version}" if self.env_version else self.env) + noise


@dataclass(frozen=True)
class Sweep:
    """A directory of runs, or a file of their results."""

    path: Path
    rows: tuple[Row, ...]
    planned: tuple[str, ...] | None
    """Names of the runs in study.json; None for a file of results."""
    diverged: tuple[tuple[str, int], ...] = ()
    """Runs and seeds that are left out, because their return is not finite."""

    @property
    def directory(self) -> Path:
        """Directory of the results."""
        return self.path if self.path.is_dir() else self.path.parent

    @property
    def name(self) -> str:
        """Name of the directory."""
        return self.directory.resolve().name

    @property
    def missing(self) -> list[str]:
        """Planned runs without a result."""
        done = {row.run for row in self.rows} | {run for run, _ in self.diverged}
        return [run for run in self.planned or () if run not in done]


def read(path: Path) -> Sweep:
    """Read the results of a sweep.

    Args:
        path: Directory of a sweep, or a file of results. A last line without an end is still being
            written and is not read.

    Raises:
        ConfigError: no sweep, no results yet, or a row that cannot be understood.
    """
    try:
        if not path.exists():
            raise ConfigError(f"{path}: must be the directory of a sweep; it does not exist")
        file = path / RESULTS if path.is_dir() else path
        if not file.exists() and not (path / "study.json").exists():
            raise ConfigError(
                f"{path}: must be the directory of a sweep, with study.json and {RESULTS}"
            )
        rows, diverged = _rows(file) if file.exists() else ((), ())
        planned = _planned(path / "study.json") if path.is_dir() else None
    except OSError as reason:
        raise ConfigError(
            f"{path}: must be a sweep that can be read ({reason.strerror})"
        ) from reason
    if not rows:
        raise ConfigError(f"{path}: must have results; {RESULTS} has none yet")
    return Sweep(path, rows, planned, diverged)


def _planned(path: Path) -> tuple[str, ...] | None:
    if not path.exists():
        return None
    try:
        return tuple(json.loads(path.read_bytes())["cells"].keys())
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError):
        raise ConfigError(f"{path}: must be an object with the runs of the sweep") from None


def _rows(path: Path) -> tuple[tuple[Row, ...], tuple[tuple[str, int], ...]]:
    """Return the rows, and the runs and seeds that diverged."""
    rows, diverged, end, number, seen = [], [], 0, 0, set()
    for number, (data, after) in enumerate(files.whole_rows(path), start=1):
        where, end = f"{path} line {number}", after
        key = _field(data, "run", where), _field(data, "seed", where)
        if key in seen:
            raise ConfigError(f"{where}: run {key[0]}, seed {key[1]} is there twice")
        seen.add(key)
        final = data.get("final")
        if isinstance(final, dict) and final.get("return_mean", 0) is None:  # null: not finite
            terminal.warn(
                f"warning: {where}: left out: the return of run {key[0]}, seed {key[1]} is not "
                "finite"
            )
            diverged.append(key)
        else:
            rows.append(_row(data, where))
    if b"\n" in path.read_bytes()[end:]:
        raise ConfigError(f"{path} line {number + 1}: must be an object in JSON")
    return tuple(rows), tuple(diverged)


PATHS = {
    "run": "cell",
    "engine": "final.engine",
    "final": "final.return_mean",
    "returns": "final.returns",
    "best": "best.return_mean",
    "curve_steps": "curve.steps",
    "curve_returns": "curve.return",
}
"""Places of the fields of a `Row` in the file, where they differ from its names."""

_KINDS = get_type_hints(Row)

_NAMES = {
    str: "a string",
    int: "a whole number",
    float: "a number",
    dict: "an object",
    np.ndarray: "a list of numbers",
    NoneType: "null",
}


def _row(data: dict[str, Any], where: str) -> Row:
    row = Row(**{name: _field(data, name, where) for name in _KINDS})
    if row.algo not in ALGORITHMS:
        raise ConfigError(f"{where}: algo: must be one of {', '.join(ALGORITHMS)}")
    steps = row.curve_steps
    if len(steps) != len(row.curve_returns) or not (np.diff(steps) > 0).all():
        raise ConfigError(f"{where}: curve: must have increasing steps and a return for each")
    try:
        return replace(row, config=upgraded(row.config))
    except ConfigError as reason:
        raise ConfigError(f"{where}: config: {reason}") from reason


def _field(data: Any, name: str, where: str) -> Any:
    """Return the value of a field, lists as arrays [N] with NaN for null."""
    path = PATHS.get(name, name)
    kinds = get_args(_KINDS[name]) or (_KINDS[name],)
    for part in path.split("."):
        if data is None and NoneType in kinds:
            return None
        if not isinstance(data, dict) or part not in data:
            raise ConfigError(f"{where}: {path}: missing")
        data = data[part]
    if np.ndarray in kinds and type(data) is list:
        if all(value is None or type(value) in (int, float) for value in data):
            return np.array(data, float)
    elif float in kinds and type(data) in (int, float):
        if math.isfinite(data):
            return float(data)
    elif type(data) in kinds:
        return data
    raise ConfigError(f"{where}: {path}: must be {' or '.join(_NAMES[kind] for kind in kinds)}")


class Published(NamedTuple):
    """A published result; `spread` and `seeds` are None if the source does not report them."""

    task: str
    samples: int
    algorithm: str
    mean: float
    spread: float | None
    seeds: int | None
    source: str


def published() -> list[Published]:
    """Return the published results of published.csv."""
    with Path(__file__).with_name("published.csv").open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return [
        Published(
            task,
            int(samples),
            algorithm,
            float(mean),
            float(spread) if spread else None,
            int(seeds) if seeds else None,
            source,
        )
        for task, samples, algorithm, mean, spread, seeds, source in rows
    ]
