"""All measurements that need an accelerator, in one run of a few minutes; see benchmarks/gpu.sh.

They are one step of every task against the same step on the CPU, the speed of each engine, and
training with several numbers of envs and seeds, with seconds to compile and memory. Each is written
at once, so that a run that is cut off keeps what it has.
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
import tyro

import dgae_jax as dg
from dgae_jax.configs.resolved import resolve
from dgae_jax.envs.registry import TASKS
from dgae_jax.learn.build import make_task, seed_keys
from dgae_jax.learn.parallel import make_trainer


@dataclass(frozen=True)
class Arguments:
    """Measurements."""

    json: Path = Path("benchmarks/results/gpu.json")
    """File to write [path]."""
    seconds: float = 2.0
    """Length of a measurement [s]."""
    limit: float = 450.0
    """Time after which no measurement begins [s]."""
    tasks: tuple[str, ...] = tuple(TASKS)
    """Tasks to step; training is on the first."""
    engines: tuple[str, ...] = ("jax", "mjx", "mjx-warp")
    """Engines."""
    physics_envs: tuple[int, ...] = (2048, 8192)
    """Numbers of envs to measure engines with [envs]."""
    num_envs: tuple[int, ...] = (16, 256, 2048, 8192)
    """Numbers of envs to train with, 16 steps each per iteration [envs]."""
    seeds: tuple[int, ...] = (1, 5)
    """Numbers of seeds in one program [runs]."""


def against_the_cpu(task: str) -> dict[str, Any]:
    """Return the largest difference to the CPU of one step, in 256 envs after 20 random steps."""
    env = dg.make_env(task, physics="jax")

    def walk(key, steps):
        state = jax.vmap(env.reset)(jax.random.split(key, 256))
        actions = jax.random.uniform(key, (steps, 256, env.action_size), minval=-1, maxval=1)

        def step(state, action):
            return jax.vmap(env.step)(state, action), None

        return jax.lax.scan(step, state, actions)[0], actions[0]

    with jax.default_device(jax.devices("cpu")[0]):
        start = jax.device_get(jax.jit(walk, static_argnums=1)(jax.random.key(0), 20))
    after = []
    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        with jax.default_device(device):
            after.append(jax.device_get(jax.jit(jax.vmap(env.step))(*start)))
    return {"task": task, "observation": float(np.abs(after[0].obs - after[1].obs).max())}


def engine(task: str, name: str, num_envs: int, arguments: Arguments) -> dict[str, Any]:
    """Return environment steps per second, and seconds to compile."""
    options = physics.Arguments(seconds=arguments.seconds, device="gpu")
    speed, compiling = physics.engine_speed(task, name, num_envs, options)
    about = {"task": task, "engine": name, "num_envs": num_envs}
    return {**about, "steps_per_second": speed, "compile_seconds": compiling}


def training(algo: str, num_envs: int, seeds: int, arguments: Arguments) -> dict[str, Any]:
    """Return samples per second of all seeds, seconds to compile, and the peak of memory."""
    config = resolve(
        dg.Config().replace(
            env=arguments.tasks[0],
            algo=algo,
            num_envs=num_envs,
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
        "algo": algo,
        "num_envs": num_envs,
        "seeds": seeds,
        "steps_per_second": speed,
        "compile_seconds": compiled,
        "peak_bytes": peak,
        "finite": finite,
    }


def measurements(arguments: Arguments) -> Iterator[tuple[str, Any]]:
    """Yield the kind of each measurement, and its function."""
    for task in arguments.tasks:
        yield "against_the_cpu", lambda task=task: against_the_cpu(task)
    for num_envs in arguments.num_envs:
        for seeds in arguments.seeds:
            for algo in ("ppo", "dppo"):
                yield "training", lambda a=algo, n=num_envs, s=seeds: training(a, n, s, arguments)
    for num_envs in arguments.physics_envs:
        for task in arguments.tasks:
            for name in arguments.engines:
                yield "engines", lambda t=task, e=name, n=num_envs: engine(t, e, n, arguments)


def main() -> None:
    """Print a line per measurement, and write the file."""
    arguments = tyro.cli(Arguments, description="Measurements on an accelerator.")
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
        except Exception as reason:  # one engine may be missing or have no memory
            row = {"failed": f"{type(reason).__name__}: {str(reason)[:200]}"}
        found.setdefault(kind, []).append(row)
        print(kind, json.dumps(row), flush=True)
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
