"""The rows of a study: one per trained seed, read strictly from `results.jsonl`.

Keys that no report needs are not looked at; those that it needs must be there and have the right type.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import ConfigError
from dgae_jax.run import files, terminal
from dgae_jax.run.evaluation import cvar

RESULTS = "results.jsonl"


@dataclass(frozen=True)
class Row:
    """One trained seed."""

    cell: str
    env: str
    env_version: str | None
    algo: str
    variant: str | None
    """Its name among the variants of a question; None in a study of algorithms."""
    seed: int
    total_steps: int
    hash: str
    """Of the configuration without its seeds: rows that share it differ by chance only."""
    engine: str
    """Where the policy was evaluated."""
    final: float
    """Mean return of the last policy over its episodes."""
    worst: float
    """Mean return of the worst quarter of them."""
    best: float | None
    """Mean return of the best of the policies that were evaluated along the way; None if none was."""
    best_steps: int | None
    curve_steps: np.ndarray
    """[I] samples, increasing."""
    curve_returns: np.ndarray
    """[I] undiscounted episode return while training; NaN where no episode has ended yet."""
    seconds: float
    samples_per_second: float
    config: dict[str, Any]
    versions: dict[str, Any]
    machine: dict[str, Any]
    git_revision: str | None
    command: str

    @property
    def average(self) -> float:
        """Episode return while training, averaged over the curve from the first on; NaN where no episode has ended."""
        known = self.curve_returns[np.isfinite(self.curve_returns)]
        return float(known.mean()) if known.size else math.nan

    @property
    def task(self) -> str:
        """The task with its version, where it has one, and whether there is noise on it."""
        noise = " with noise" if any((self.config.get("noise") or {}).values()) else ""
        return (f"{self.env}-{self.env_version}" if self.env_version else self.env) + noise


@dataclass(frozen=True)
class Study:
    """A directory of runs, or a file of their results."""

    path: Path
    rows: tuple[Row, ...]
    planned: tuple[str, ...] | None
    """Names of the cells in study.json; None for a file of results alone."""
    diverged: tuple[tuple[str, int], ...] = ()
    """Cells and seeds without a row here, because their return is not finite."""

    @property
    def name(self) -> str:
        """Of the directory."""
        return self.directory.resolve().name

    @property
    def directory(self) -> Path:
        """Where the results lie."""
        return self.path if self.path.is_dir() else self.path.parent

    @property
    def missing(self) -> list[str]:
        """Planned cells without a result."""
        done = {row.cell for row in self.rows} | {cell for cell, _ in self.diverged}
        return [cell for cell in self.planned or () if cell not in done]


def read(path: Path) -> Study:
    """The study in the directory `path`, or of the results in the file `path`.

    Raises ConfigError, in one line, where there is no study, no result yet, or a row that cannot be understood.
    """
    try:
        if not path.exists():
            raise ConfigError(f"{path}: must be the directory of a study; there is nothing")
        file = path / RESULTS if path.is_dir() else path
        if not file.exists() and not (path / "study.json").exists():
            raise ConfigError(
                f"{path}: must be the directory of a study, with study.json and {RESULTS}"
            )
        rows, diverged = _rows(file) if file.exists() else ((), ())
        planned = _planned(path / "study.json") if path.is_dir() else None
    except OSError as reason:
        raise ConfigError(
            f"{path}: must be a study that can be read ({reason.strerror})"
        ) from reason
    if not rows:
        raise ConfigError(f"{path}: must have results; {RESULTS} has none yet")
    return Study(path, rows, planned, diverged)


def _planned(path: Path) -> tuple[str, ...] | None:
    if not path.exists():
        return None
    try:
        cells = json.loads(path.read_bytes())["cells"]
        return tuple(cells.keys())
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError):
        raise ConfigError(f"{path}: must be an object with the cells of the study") from None


def _rows(path: Path) -> tuple[tuple[Row, ...], tuple[tuple[str, int], ...]]:
    """The rows, and the cells and seeds that diverged."""
    rows, diverged, end, number, seen = [], [], 0, 0, set()
    for number, (data, after) in enumerate(files.whole_rows(path), start=1):
        end = after
        if _diverged(data):
            cell, seed = (
                _field(data, name, f"{path} line {number}", *FIELDS[name])
                for name in ("cell", "seed")
            )
            terminal.warn(
                f"warning: {path} line {number}: left out, because the return of cell {cell}, seed {seed} is not finite"
            )
            diverged.append((cell, seed))
            continue
        row = _row(data, f"{path} line {number}")
        if (row.cell, row.seed) in seen:
            raise ConfigError(
                f"{path} line {number}: cell {row.cell}, seed {row.seed} is there twice"
            )
        seen.add((row.cell, row.seed))
        rows.append(row)
    if b"\n" in path.read_bytes()[end:]:  # a last line without an end is still being written
        raise ConfigError(f"{path} line {number + 1}: must be an object in JSON")
    return tuple(rows), tuple(diverged)


def _diverged(data: dict[str, Any]) -> bool:
    """JSON has null for a return that is not finite."""
    final = data.get("final")
    return isinstance(final, dict) and final.get("return_mean", 0) is None


def _is(*kinds: type) -> Callable[[Any], bool]:
    return lambda value: type(value) in kinds


def _number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _list(test: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and all(map(test, value))


_numbers = _list(_number)
_TEXT, _TEXT_OR_NONE = (_is(str), "a string"), (_is(str, type(None)), "a string or null")
_WHOLE, _NUMBER, _OBJECT = (
    (_is(int), "a whole number"),
    (_number, "a number"),
    (_is(dict), "an object"),
)

FIELDS = {
    "cell": _TEXT, "env": _TEXT, "env_version": _TEXT_OR_NONE, "algo": (ALGORITHMS.__contains__, f"one of {', '.join(ALGORITHMS)}"),
    "variant": _TEXT_OR_NONE, "seed": _WHOLE, "total_steps": _WHOLE, "hash": _TEXT, "final": _OBJECT, "final.engine": _TEXT,
    "final.return_mean": _NUMBER, "final.returns": (lambda value: _numbers(value) and bool(value), "a list of numbers, one at least"),
    "best": (_is(dict, type(None)), "an object or null"), "curve": _OBJECT,
    "curve.steps": (_list(_is(int)), "a list of whole numbers"),
    "curve.return": (_list(lambda value: value is None or _number(value)), "a list of numbers, null where there is none"),
    "seconds": _NUMBER, "samples_per_second": _NUMBER, "config": _OBJECT, "versions": _OBJECT, "machine": _OBJECT,
    "git_revision": _TEXT_OR_NONE, "command": _TEXT,
}  # fmt: skip
"""What a row must have, by its path, and what each must be."""

BEST = {"best.steps": _WHOLE, "best.return_mean": _NUMBER}
"""What it must have besides where `best` is an object."""


def _row(data: dict[str, Any], where: str) -> Row:
    found = {path: _field(data, path, where, *kind) for path, kind in FIELDS.items()}
    best = (
        {path: _field(data, path, where, *kind) for path, kind in BEST.items()}
        if found["best"]
        else {}
    )
    steps, returns = np.array(found["curve.steps"], float), np.array(found["curve.return"], float)
    if len(steps) != len(returns) or (np.diff(steps) <= 0).any():
        raise ConfigError(f"{where}: curve: must have increasing steps and a return for each")
    same = ("cell", "env", "env_version", "algo", "variant", "seed", "total_steps", "hash", "seconds", "samples_per_second", "config",
            "versions", "machine", "git_revision", "command")  # fmt: skip
    return Row(
        **{name: found[name] for name in same},
        engine=found["final.engine"],
        final=float(found["final.return_mean"]),
        worst=cvar(np.array(found["final.returns"]), 0.25),
        best=best.get("best.return_mean"),
        best_steps=best.get("best.steps"),
        curve_steps=steps,
        curve_returns=returns,
    )


def _field(data: Any, path: str, where: str, test: Callable[[Any], bool], allowed: str) -> Any:
    for name in path.split("."):
        if name not in data:
            raise ConfigError(f"{where}: {path}: missing")
        data = data[name]
    try:
        accepted = test(data)
    except TypeError:  # not hashable
        accepted = False
    if not accepted:
        raise ConfigError(f"{where}: {path}: must be {allowed}")
    return data
