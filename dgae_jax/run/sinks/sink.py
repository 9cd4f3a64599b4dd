"""What a sink is: where the metrics of a run go beside its own files."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import flat, to_dict

Row = dict[str, Any]
"""A row of `metrics.jsonl` or of `evaluations.jsonl`: `steps`, `seed`, and numbers by name, None where there is none."""


class Place(NamedTuple):
    """What a sink is opened with."""

    run_dir: Path
    config: ResolvedConfig
    ids: dict[str, str]
    """By seed, how the viewer calls its run; empty at first, kept in the run directory from then on."""
    kept: int
    """Samples of each run up to which the sink has the metrics; what one that goes back has of later ones is not to be seen."""


class Sink(NamedTuple):
    """Open to one run directory; each of its functions may raise anything, which gives the sink up."""

    rows: Callable[[list[Row]], None]
    """Take rows of metrics, in their order: all seeds of each iteration."""
    evaluations: Callable[[list[Row]], None]
    """Take the evaluations of all seeds."""
    close: Callable[[list[Path], bool], None]
    """Take pictures and films, and end; told whether the run reached its end."""


def seeds_of(config: ResolvedConfig) -> range:
    """The seeds that a run trains side by side: one run of the viewer each."""
    return range(config.seed, config.seed + config.num_seeds)


def name_of(place: Place, seed: int) -> str:
    """How the run of one seed is shown."""
    directory = place.run_dir.resolve().name
    return directory if place.config.num_seeds == 1 else f"{directory}-seed-{seed}"


def settings(config: ResolvedConfig, seed: int) -> dict[str, Any]:
    """What the run of one seed was configured by: values by path, those that are unset left out."""
    return {
        path: value
        for path, value in flat(to_dict(dataclasses.replace(config, seed=seed))).items()
        if value is not None
    }


def numbers(row: Row) -> dict[str, float]:
    """The metrics of a row that exist."""
    return _finite({name: value for name, value in row.items() if name not in ("steps", "seed")})


def scores(row: Row) -> dict[str, float]:
    """The numbers of an evaluation of one seed that exist."""
    return _finite({f"evaluation/{name}": row[name] for name in ("return_mean", "return_std")})


def _finite(values: dict[str, Any]) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in values.items()
        if value is not None and math.isfinite(value)
    }
