"""Results that others have published, from published.csv beside this file."""

import csv
from pathlib import Path
from typing import NamedTuple

from dgae_jax.configs.config import ConfigError

DOCS = Path(__file__).parents[2] / "docs"
"""The documents of the repository; an installation without the repository has none."""

FILE = Path(__file__).with_name("published.csv")
"""The published results, with their sources."""


class Published(NamedTuple):
    """One published number; `spread` and `seeds` are empty where the source does not say."""

    task: str
    samples: int
    algorithm: str
    mean: float
    spread: float | None
    seeds: int | None
    source: str


def read(path: Path = FILE) -> list[Published]:
    """All rows; raises ConfigError where there is no such file or a row is not understood."""
    try:
        with path.open(newline="") as file:
            return [_row(row) for row in csv.DictReader(file)]
    except OSError as reason:
        raise ConfigError(f"published: needs {path} ({reason.strerror})", "published") from reason
    except (KeyError, ValueError, TypeError) as reason:
        raise ConfigError(
            f"{path}: must have the columns {', '.join(Published._fields)} with numbers in them ({reason})"
        ) from reason


def _row(row: dict[str, str]) -> Published:
    spread, seeds = row["spread"], row["seeds"]
    numbers = int(row["samples"]), row["algorithm"], float(row["mean"])
    return Published(
        row["task"],
        *numbers,
        float(spread) if spread else None,
        int(seeds) if seeds else None,
        row["source"],
    )
