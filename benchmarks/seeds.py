"""Several seeds of a run: side by side in one program on all cores, or each in a process of its own on one core.

    python benchmarks/seeds.py --json benchmarks/results/seeds.json

Samples per second of all seeds together. Nothing else should run on the machine meanwhile.
"""

import dataclasses
import itertools
import json
import multiprocessing
import os
from dataclasses import dataclass
from pathlib import Path

from throughput import iteration, setting

from dgae_jax.cli import parse
from dgae_jax.configs.config import Config
from dgae_jax.physics.registry import cores
from dgae_jax.run import runtime


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

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


def rate(config: Config, seconds: float, core: int | None = None) -> float:
    """Samples per second, on one core or on all."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    return config.num_seeds * config.samples_per_iteration / iteration(config, seconds).seconds


def main() -> None:
    """Print a line for each algorithm and engine."""
    arguments, context = (
        parse.arguments(Arguments, description="Seeds side by side."),
        multiprocessing.get_context("spawn"),
    )
    rows = []
    print(
        f"{cores()} cores, {arguments.seeds} seeds; samples per second of all\n{'':20s} {'one program':>12s} {'a process each':>15s}"
    )
    for task, algo, physics in itertools.product(
        arguments.tasks, arguments.algos, arguments.physics
    ):
        one = setting(task, algo, physics, 64)
        with context.Pool(1) as pool:
            together = pool.apply(
                rate, (dataclasses.replace(one, num_seeds=arguments.seeds), arguments.seconds)
            )
        with context.Pool(cores()) as pool:
            apart = sum(
                pool.starmap(
                    rate,
                    [(one, arguments.seconds, core) for core in sorted(os.sched_getaffinity(0))],
                    chunksize=1,
                )
            )
        rows.append(
            {
                "task": task,
                "algo": algo,
                "physics": physics,
                "seeds": arguments.seeds,
                "one_program": together,
                "a_process_each": apart,
            }
        )
        print(f"{task:7s} {algo:5s} {physics:6s} {together:12,.0f} {apart:15,.0f}", flush=True)
    if arguments.json:
        arguments.json.write_text(
            json.dumps({"machine": runtime.hardware(), "rows": rows}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
