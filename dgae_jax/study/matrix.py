"""A study: a list of configurations with names, each of which is trained in a run directory of its own.

STUDY/study.json              the cells: names and configurations
STUDY/runs/CELL/              one run directory each
STUDY/logs/CELL.log           what each of them said
STUDY/results.jsonl           a row per trained seed
STUDY/policies/CELL.msgpack   the policy at the end
"""

import contextlib
import dataclasses
import itertools
import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.serial import differences, from_dict, to_dict
from dgae_jax.run import directory, files

SCHEMA = 1
"""Version of `study.json`."""

NAME = re.compile(r"\w[\w.+-]{,199}")
"""What a cell may be called."""


class Cell(NamedTuple):
    """One run of a study."""

    name: str
    """ENV-ALGO-SEED, or ENV-VARIANT-SEED, and the last of its seeds where it trains several."""
    config: ResolvedConfig

    @property
    def kind(self) -> str:
        """The algorithm or the variant."""
        before, after = _name(
            self.config.env, "/", range(self.config.seed, self.config.seed + self.config.num_seeds)
        ).split("/")
        return self.name.removeprefix(before).removesuffix(after)


class Study(NamedTuple):
    """A directory, and all cells that were ever asked for there."""

    path: Path
    cells: tuple[Cell, ...]
    commands: dict[str, str]
    """The command line that asked for each cell first, by the name of the cell."""

    def run_dir(self, cell: Cell) -> Path:
        """Where a cell is trained."""
        return self.path / "runs" / cell.name

    def log(self, cell: Cell) -> Path:
        """What it said."""
        return self.path / "logs" / f"{cell.name}.log"

    def policy(self, cell: Cell) -> Path:
        """Its policy at the end."""
        return self.path / "policies" / f"{cell.name}.msgpack"


def matrix(
    tasks: Sequence[str],
    kinds: Sequence[str],
    seeds: Sequence[int],
    per_run: int,
    make: Callable[[str, str], ResolvedConfig],
) -> list[Cell]:
    """Tasks × kinds × seeds, the first seeds of all first; a kind is an algorithm or a variant.

    `make(task, kind)` is the configuration of a pair. `per_run` seeds, which must follow each other, are trained side by side in
    one run.
    """
    configs = {(task, kind): make(task, kind) for task, kind in itertools.product(tasks, kinds)}
    seeded = (
        (task, kind, config, some)
        for some in _groups(seeds, per_run)
        for (task, kind), config in configs.items()
    )
    return [
        Cell(
            _name(task, kind, some), dataclasses.replace(config, seed=some[0], num_seeds=len(some))
        )
        for task, kind, config, some in seeded
    ]


def _groups(seeds: Sequence[int], per_run: int) -> Iterator[Sequence[int]]:
    for i in range(0, len(seeds), per_run):
        some = seeds[i : i + per_run]
        if list(some) != list(range(some[0], some[0] + len(some))):
            raise invalid(
                "seeds_per_run",
                per_run,
                f"1, or a number of seeds that follow each other, not {list(some)}",
            )
        yield some


def _name(task: str, kind: str, seeds: Sequence[int]) -> str:
    last = f"-{seeds[-1]}" if len(seeds) > 1 else ""
    return f"{re.sub('[:/]', '_', task)}-{kind}-{seeds[0]}{last}"


@contextlib.contextmanager
def opened(path: Path, cells: Sequence[Cell], command: str) -> Iterator[Study]:
    """The study at `path` with these cells beside those that it has, made if there is none; nobody else has it meanwhile.

    `command` asks for them.
    Raises ConfigError if `path` holds anything else, cannot be written or is in use, or if a cell has another configuration there.
    """
    try:
        if (
            path.exists()
            and not (path / "study.json").exists()
            and any(each.name != ".lock" for each in path.iterdir())
        ):
            raise ConfigError(f"study {path}: must be a study, or a new or empty directory")
        path.mkdir(parents=True, exist_ok=True)
        with (path / ".lock").open("w") as lock:
            directory.hold(
                lock, ConfigError(f"study {path}: must not be in use; another process runs it")
            )
            before = read(path) if (path / "study.json").exists() else Study(path, (), {})
            study = _joined(before, cells, command)
            for part in ("runs", "logs", "policies"):
                (path / part).mkdir(exist_ok=True)
            if study != before:
                each = {name: to_dict(config) for name, config in study.cells}
                files.write_json(
                    path / "study.json",
                    {"schema": SCHEMA, "cells": each, "commands": study.commands},
                )
            yield study
    except OSError as reason:
        raise ConfigError(
            f"study {path}: must be a directory that can be written ({reason.strerror})"
        ) from reason


def _joined(before: Study, cells: Sequence[Cell], command: str) -> Study:
    there = dict(before.cells)
    for name, config in cells:
        for setting, (ours, theirs) in differences(config, there.get(name, config)).items():
            raise ConfigError(
                f"cell {name}: its {setting} must be {theirs} as in {before.path}, not {ours}; another study can have it so"
            )
    new = [cell for cell in cells if cell.name not in there]
    return Study(
        before.path,
        (*before.cells, *new),
        {**before.commands, **{cell.name: command for cell in new}},
    )


def read(path: Path) -> Study:
    """The study at `path`; raises ConfigError if there is none that can be read."""
    try:
        data = json.loads((path / "study.json").read_bytes())
        if data["schema"] != SCHEMA:
            raise ConfigError(
                f"{path / 'study.json'}: has schema {data['schema']}, this version reads {SCHEMA}"
            )
        cells = tuple(
            Cell(name, resolve(from_dict(config))) for name, config in data["cells"].items()
        )
        for name, _ in cells:
            if not NAME.fullmatch(name):  # it becomes the name of files
                raise ValueError(f"cell {name[:100]!r} has no such name")
        return Study(path, cells, dict(data["commands"]))
    except OSError as reason:
        raise ConfigError(
            f"study {path}: must be the directory of a study ({reason.strerror})"
        ) from reason
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as reason:
        raise ConfigError(
            f"{path / 'study.json'}: must be a study that can be read ({reason})"
        ) from reason
