"""A sweep: named configurations, each trained in a run directory of its own.

SWEEP/study.json             names, configurations and commands of all runs
SWEEP/runs/NAME/             run directory
SWEEP/logs/NAME.log          output of the run
SWEEP/results.jsonl          a row per trained seed
SWEEP/policies/NAME.msgpack  final policy
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
"""Allowed names of runs, which become names of files."""


Runs = dict[str, ResolvedConfig]
"""Configurations by the names of runs: ENV-LABEL-SEED, and -LAST for several seeds."""


class Sweep(NamedTuple):
    """A directory and all runs that were ever asked for there."""

    path: Path
    runs: Runs
    commands: dict[str, str]
    """The command line that first asked for each run, by its name."""

    def run_dir(self, run: str) -> Path:
        """Return the run directory."""
        return self.path / "runs" / run

    def log(self, run: str) -> Path:
        """Return the file of the run's output."""
        return self.path / "logs" / f"{run}.log"

    def policy(self, run: str) -> Path:
        """Return the file of the run's final policy."""
        return self.path / "policies" / f"{run}.msgpack"


def grid(
    tasks: Sequence[str],
    labels: Sequence[str],
    seeds: Sequence[int],
    seeds_per_run: int,
    make: Callable[[str, str], ResolvedConfig],
) -> Runs:
    """Return tasks × labels × seeds, the first seeds of all of them first.

    Args:
        tasks: names of envs.
        labels: names of algorithms or variants.
        seeds: seeds of each pair.
        seeds_per_run: consecutive seeds that are trained in one program.
        make: `make(task, label)` returns the configuration of a pair.

    Raises:
        ConfigError: the seeds of one run are not consecutive.
    """
    configs = {pair: make(*pair) for pair in itertools.product(tasks, labels)}
    groups = [seeds[i : i + seeds_per_run] for i in range(0, len(seeds), seeds_per_run)]
    for group in groups:
        if list(group) != list(range(group[0], group[0] + len(group))):
            allowed = f"1, or a number of consecutive seeds, not {list(group)}"
            raise invalid("seeds_per_run", seeds_per_run, allowed)
    return {
        _name(*pair, group): dataclasses.replace(config, seed=group[0], num_seeds=len(group))
        for group in groups
        for pair, config in configs.items()
    }


def _name(task: str, label: str, seeds: Sequence[int]) -> str:
    last = f"-{seeds[-1]}" if len(seeds) > 1 else ""
    return f"{re.sub('[:/]', '_', task)}-{label}-{seeds[0]}{last}"


def label_of(run: str, config: ResolvedConfig) -> str:
    """Return the algorithm or the variant in the name of a run."""
    seeds = range(config.seed, config.seed + config.num_seeds)
    before, after = _name(config.env, "/", seeds).split("/")
    return run.removeprefix(before).removesuffix(after)


@contextlib.contextmanager
def opened(path: Path, runs: Runs, command: str) -> Iterator[Sweep]:
    """Open a sweep, with some runs added to those that it has, and lock it.

    Args:
        path: directory of a sweep, or a new or empty one.
        runs: runs that the sweep must have.
        command: the command line that asks for them.

    Raises:
        ConfigError: the directory holds anything else, cannot be written or is in use, or a run
            has another configuration there.
    """
    with directory.must_be("a directory that can be written", path):
        is_sweep = (path / "study.json").exists()
        if path.exists() and not is_sweep and any(x.name != ".lock" for x in path.iterdir()):
            raise ConfigError(f"{path}: must be a sweep, or a new or empty directory")
        path.mkdir(parents=True, exist_ok=True)
        with (path / ".lock").open("w") as lock:
            in_use = f"{path}: must not be in use; another process runs it"
            directory.hold(lock, ConfigError(in_use))
            before = read(path) if is_sweep else Sweep(path, {}, {})
            sweep = _joined(before, runs, command)
            for part in ("runs", "logs", "policies"):
                (path / part).mkdir(exist_ok=True)
            if sweep != before:
                cells = {run: to_dict(config) for run, config in sweep.runs.items()}
                data = {"schema": SCHEMA, "cells": cells, "commands": sweep.commands}
                files.write_json(path / "study.json", data)
            yield sweep


def _joined(before: Sweep, runs: Runs, command: str) -> Sweep:
    for run, config in runs.items():
        for setting, (ours, theirs) in differences(config, before.runs.get(run, config)).items():
            allowed = f"must be {theirs} as in {before.path}, not {ours}; or use another directory"
            raise ConfigError(f"run {run}: its {setting} {allowed}")
    new = {run: command for run in runs if run not in before.runs}
    return Sweep(before.path, before.runs | runs, before.commands | new)


def read(path: Path) -> Sweep:
    """Read `study.json`; configurations of older schemas are upgraded.

    Raises:
        ConfigError: there is no sweep that can be read.
    """
    file = path / "study.json"
    with directory.must_be("the directory of a sweep", path):
        content = file.read_bytes()
    try:
        data = json.loads(content)
        if data["schema"] != SCHEMA:
            raise ValueError(f"its schema is {data['schema']}, not {SCHEMA}")
        runs = {run: resolve(from_dict(config)) for run, config in data["cells"].items()}
        for run in runs:
            if not NAME.fullmatch(run):
                raise ValueError(f"{run[:100]!r} cannot be the name of a run")
        return Sweep(path, runs, dict(data["commands"]))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as reason:
        raise ConfigError(f"{file}: must be a sweep that can be read ({reason})") from reason
