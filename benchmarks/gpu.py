"""Everything that needs an accelerator, in one run of a few minutes: benchmarks/gpu.sh installs and runs it.

The step of every task on the device against the same step on the CPU; the speed of each engine; training at several numbers of worlds and
seeds, with its seconds of compiling and its memory. What is measured is written at once, so that a run that is cut off leaves
what it has.
"""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import physics

import dgae_jax as dg
from dgae_jax.cli import parse
from dgae_jax.configs.resolved import resolve
from dgae_jax.envs.registry import TASKS
from dgae_jax.learn.build import make_task, make_trainer, seed_keys


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    json: Path = Path("benchmarks/results/gpu.json")
    """File to write [path]."""
    seconds: float = 2.0
    """Length of a measurement [s]."""
    limit: float = 450.0
    """Begin nothing more after so long [s]."""
    tasks: tuple[str, ...] = tuple(TASKS)
    """Tasks to step; training is on the first."""
    engines: tuple[str, ...] = ("jax", "mjx", "mjx-warp")
    """Engines."""
    physics_worlds: tuple[int, ...] = (2048, 8192)
    """Worlds to measure engines with."""
    worlds: tuple[int, ...] = (16, 256, 2048, 8192)
    """Worlds to train with, 16 steps each per iteration."""
    seeds: tuple[int, ...] = (1, 5)
    """Seeds side by side."""


def against_the_cpu(task: str) -> dict[str, Any]:
    """The largest difference of one step on the device from the same step on the CPU, over 256 worlds after 20 random steps."""
    env = dg.make_env(task, physics="jax")

    def walk(key, steps):
        state = jax.vmap(env.reset)(jax.random.split(key, 256))
        actions = jax.random.uniform(key, (steps, 256, env.action_size), minval=-1, maxval=1)
        return jax.lax.scan(lambda s, a: (jax.vmap(env.step)(s, a), None), state, actions)[
            0
        ], actions[0]

    with jax.default_device(jax.devices("cpu")[0]):
        given = jax.device_get(jax.jit(walk, static_argnums=1)(jax.random.key(0), 20))
    after = []
    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        with jax.default_device(device):
            after.append(jax.device_get(jax.jit(jax.vmap(env.step))(*given)))
    return {"task": task, "observation": float(np.abs(after[0].obs - after[1].obs).max())}


def engine(task: str, name: str, worlds: int, arguments: Arguments) -> dict[str, Any]:
    """Environment steps per second, and seconds to compile."""
    speed, compiling = physics.engine_speed(
        task, name, worlds, physics.Arguments(seconds=arguments.seconds, device="gpu")
    )
    return {
        "task": task,
        "engine": name,
        "worlds": worlds,
        "steps_per_second": speed,
        "compile_seconds": compiling,
    }


def training(algo: str, worlds: int, seeds: int, arguments: Arguments) -> dict[str, Any]:
    """Samples per second of all seeds together, seconds to compile, and the most memory so far."""
    config = resolve(
        dg.Config(
            env=arguments.tasks[0],
            algo=algo,
            num_envs=worlds,
            num_steps=16,
            num_seeds=seeds,
            total_steps=10**7,
        )
    )
    began = time.perf_counter()
    trainer = make_trainer(make_task(config), 1)
    state = trainer.init(config, seed_keys(config))
    state, rows = jax.block_until_ready(trainer.dispatch(config, state, 1))
    compiled, since, count = time.perf_counter() - began, time.perf_counter(), 0
    while time.perf_counter() - since < arguments.seconds:
        state, rows = jax.block_until_ready(trainer.dispatch(config, state, 1))
        count += 1
    speed = count * seeds * config.samples_per_iteration / (time.perf_counter() - since)
    peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    finite = all(bool(jnp.isfinite(rows[f"{part}/loss"]).all()) for part in ("policy", "critic"))
    return {
        "algo": algo, "worlds": worlds, "seeds": seeds, "steps_per_second": speed, "compile_seconds": compiled,
        "peak_bytes": peak, "finite": finite,
    }  # fmt: skip


def measurements(arguments: Arguments) -> Iterator[tuple[str, Any]]:
    """All of them, to be made one after the other: what kind, and how."""
    for task in arguments.tasks:
        yield "against_the_cpu", lambda task=task: against_the_cpu(task)
    for worlds in arguments.worlds:
        for seeds in arguments.seeds:
            for algo in ("ppo", "dppo"):
                yield "training", lambda a=algo, w=worlds, s=seeds: training(a, w, s, arguments)
    for worlds in arguments.physics_worlds:
        for task in arguments.tasks:
            for name in arguments.engines:
                yield "engines", lambda t=task, n=name, w=worlds: engine(t, n, w, arguments)


def main() -> None:
    """One line per measurement, and the file."""
    arguments = parse.arguments(Arguments, description="What an accelerator makes of it.")
    jax.config.update("jax_enable_compilation_cache", False)
    device, began = jax.devices()[0], time.monotonic()
    found: dict[str, Any] = {
        "device": device.device_kind,
        "platform": device.platform,
        "jax": jax.__version__,
        "left_out": 0,
    }
    for kind, measure in measurements(arguments):
        if time.monotonic() - began > arguments.limit:
            found["left_out"] += 1
            continue
        try:
            row = measure()
        except (
            Exception
        ) as reason:  # one engine that is not installed, or has no room, leaves the others
            row = {"failed": f"{type(reason).__name__}: {str(reason)[:200]}"}
        found.setdefault(kind, []).append(row)
        print(kind, json.dumps(row), flush=True)
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
