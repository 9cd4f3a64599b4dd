"""Results of a sweep: one row per trained seed, read strictly from `results.jsonl`."""

import contextlib
import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import ConfigError, flat
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
    def settings(self) -> dict[str, Any]:
        """The configuration by dotted path, without seeds."""
        settings = flat(self.config)
        return {name: x for name, x in settings.items() if name not in ("seed", "num_seeds")}

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
    missing: tuple[str, ...]
    """Names of the runs in study.json that have no result."""
    diverged: tuple[tuple[str, int], ...]
    """Runs and seeds that are left out, because their return is not finite."""

    @property
    def directory(self) -> Path:
        """Directory of the results."""
        return self.path if self.path.is_dir() else self.path.parent

    @property
    def name(self) -> str:
        """Name of the directory."""
        return self.directory.resolve().name


def read(path: Path) -> Sweep:
    """Read the results of a sweep.

    Args:
        path: Directory of a sweep, or a file of results. A last line without an end is still being
            written and is not read.

    Raises:
        ConfigError: no results yet, or a row that cannot be understood.
    """
    file = path / RESULTS if path.is_dir() else path
    try:
        found = _rows(file) if file.exists() else {}
    except OSError as reason:
        raise ConfigError(f"{path}: cannot be read ({reason.strerror})") from reason
    rows = tuple(row for row in found.values() if row)
    if not rows:
        raise ConfigError(f"{path}: must be the directory of a sweep with results in {RESULTS}")
    planned = files.read_object(path / "study.json").get("cells", {})
    done = {run for run, _ in found}
    diverged = tuple(key for key, row in found.items() if row is None)
    return Sweep(path, rows, tuple(run for run in planned if run not in done), diverged)


def _rows(path: Path) -> dict[tuple[str, int], Row | None]:
    """Return the row of each run and seed; None if its return is not finite."""
    rows, end, number = {}, 0, 0
    for number, (data, after) in enumerate(files.whole_rows(path), start=1):
        where, end = f"{path} line {number}", after
        key = run, seed = _field(data, "run", where), _field(data, "seed", where)
        if key in rows:
            raise ConfigError(f"{where}: run {run}, seed {seed} is there twice")
        final = data.get("final")
        diverged = isinstance(final, dict) and final.get("return_mean", 0) is None
        rows[key] = None if diverged else _row(data, where)
        if diverged:
            terminal.warn(f"warning: {where}: left out: the return of {run} is not finite")
    if b"\n" in path.read_bytes()[end:]:
        raise ConfigError(f"{path} line {number + 1}: must be an object in JSON")
    return rows


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
    """Return the value of a field; null if it is missing, lists as arrays [N] with NaN for null."""
    path, kind = PATHS.get(name, name), _KINDS[name]
    value = data
    for part in path.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    if kind is np.ndarray and isinstance(value, list):
        with contextlib.suppress(TypeError, ValueError):
            return np.array(value, float)
    elif isinstance(value, kind) or (type(value) is int and float in (kind, *get_args(kind))):
        return value
    raise ConfigError(f"{where}: {path}: must be {getattr(kind, '__name__', kind)}, not {value!r}")


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
    kinds = (str, int, str, float, float, int, str)
    with Path(__file__).with_name("published.csv").open(newline="") as file:
        return [
            Published._make(kind(x) if x else None for kind, x in zip(kinds, row, strict=True))
            for row in list(csv.reader(file))[1:]
        ]
