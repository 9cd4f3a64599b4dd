"""Several seeds of a run: in one program on all cores, or in a process per core.

    python benchmarks/seeds.py --json benchmarks/results/seeds.json

Samples per second of all seeds together. Nothing else should run on the machine.
"""

import dataclasses
import itertools
import json
import multiprocessing
import os
from dataclasses import dataclass
from pathlib import Path

import tyro
from throughput import iteration, setting

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.physics import cores
from dgae_jax.run import runtime


@dataclass(frozen=True)
class Arguments:
    """Measurements."""

    seconds: float = 5.0
    """Time to measure each way, after compilation [s]."""
    tasks: tuple[str, ...] = ("hopper",)
    """Tasks."""
    algos: tuple[str, ...] = ("ppo", "dppo")
    """Algorithms."""
    physics: tuple[str, ...] = ("native", "jax")
    """Engines."""
    seeds: int = 4
    """Seeds side by side, a multiple of the cores [runs]."""
    json: Path | None = None
    """File to keep the numbers in [path]."""


def rate(config: ResolvedConfig, seconds: float, core: int | None = None) -> float:
    """Return samples per second, on one core or on all."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    return config.num_seeds * config.samples_per_iteration / iteration(config, seconds).seconds


def main() -> None:
    """Print a line for each algorithm and engine."""
    arguments = tyro.cli(Arguments, description="Seeds side by side.")
    context, rows = multiprocessing.get_context("spawn"), []
    print(f"{cores()} cores, {arguments.seeds} seeds; samples per second of all")
    print(f"{'':20s} {'one program':>12s} {'a process each':>15s}")
    for task, algo, physics in itertools.product(
        arguments.tasks, arguments.algos, arguments.physics
    ):
        one = setting(task, algo, physics, 64)
        several = dataclasses.replace(one, num_seeds=arguments.seeds)
        with context.Pool(1) as pool:
            together = pool.apply(rate, (several, arguments.seconds))
        runs = [(one, arguments.seconds, core) for core in sorted(os.sched_getaffinity(0))]
        with context.Pool(cores()) as pool:
            apart = sum(pool.starmap(rate, runs, chunksize=1))
        row = {"task": task, "algo": algo, "physics": physics, "seeds": arguments.seeds}
        rows.append({**row, "one_program": together, "a_process_each": apart})
        print(f"{task:7s} {algo:5s} {physics:6s} {together:12,.0f} {apart:15,.0f}", flush=True)
    if arguments.json:
        found = {"machine": runtime.hardware(), "rows": rows}
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
