"""Training steps per second, ours and others', in one run, and over a roofline.

    pip install -e ".[bench]" && python benchmarks/throughput.py --json benchmarks/results/new.json

Everyone trains on the same task with the same network (tanh), samples per iteration, epochs,
minibatches and normalization. stable-baselines3 and sb3-contrib run with 1, 8 and 16 envs in one
process, 8 and 16 in processes, on one thread of torch and on all; the fastest counts. PPO of Brax
and of rejax runs on our own `jax` engine.

The roofline is the time of an iteration in which all cores do nothing but simulate (C MuJoCo),
multiply matrices (the operations that the program counts, at the highest rate measured here) and
compute the quantile-Huber loss (at the rate measured here). Nothing else should run.
"""

import dataclasses
import functools
import itertools
import json
import multiprocessing
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import peers
import peers_jax
import tyro
from mujoco.batch import Batch
from table import PEER_OF, rival_of
from turns import counted

import dgae_jax as dg
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.learn import devices
from dgae_jax.learn.build import make_policy, make_task, seed_keys
from dgae_jax.learn.iteration import _estimate, _roll_out, sampler
from dgae_jax.learn.parallel import COMPILER_OPTIONS, make_trainer
from dgae_jax.learn.types import InferenceState
from dgae_jax.physics import cores
from dgae_jax.run import runtime
from dgae_jax.run.options import RunOptions


@dataclass(frozen=True)
class Arguments:
    """Measurements."""

    seconds: float = 10.0
    """Time to measure each setting, after compilation [s]."""
    tasks: tuple[str, ...] = ("hopper", "ant")
    """Tasks."""
    algos: tuple[str, ...] = tuple(PEER_OF)
    """Our algorithms."""
    physics: tuple[str, ...] = ("native", "jax")
    """Engines of ours to measure."""
    widths: tuple[int, ...] = (64, 256)
    """Widths of the two hidden layers; 256 is the paper's [units]."""
    peers: bool = True
    """Measure the peers too."""
    json: Path | None = None
    """File to keep everything in [path]."""


@dataclass(frozen=True)
class Row:
    """One measurement of ours; times are of one iteration."""

    task: str
    algo: str
    physics: str
    width: int
    num_envs: int
    devices: int
    compile_seconds: float
    steps_per_second: float
    roofline: float
    """Steps per second at best."""
    parts: dict[str, float]
    """Each part run alone [ms]."""


def fastest(f: Callable[[], Any], seconds: float) -> float:
    """Return the seconds of the fastest call, of those that fit after one that compiles."""
    jax.block_until_ready(f())
    ends = [time.perf_counter()]
    while ends[-1] - ends[0] < seconds:
        jax.block_until_ready(f())
        ends.append(time.perf_counter())
    return min(b - a for a, b in itertools.pairwise(ends))


def setting(task: str, algo: str, physics: str, width: int) -> ResolvedConfig:
    """Return Walker2d's preset on any task, with other widths.

    A2C takes one gradient step per rollout of 8, as its peer does.
    """
    config = dg.preset("tuned", algo, "walker2d")
    config = config.replace(env=task, physics=physics)
    config = config.replace(**{f"{part}.hidden": (width, width) for part in ("policy", "critic")})
    if PEER_OF[algo] == "A2C":
        steps = {"optimizer": "rmsprop", "epochs": 1, "minibatches": 1}
        both = {f"{part}.{name}": x for part in ("policy", "critic") for name, x in steps.items()}
        config = config.replace(num_steps=8, **both)
    return resolve(config)


class Iteration(NamedTuple):
    """Times of an iteration, and of compiling it."""

    compile_seconds: float
    seconds: float
    devices: int


def iteration(config: ResolvedConfig, seconds: float) -> Iteration:
    """Time compilation, then as many iterations as fit, one per call."""
    jax.config.update("jax_enable_compilation_cache", False)
    count = runtime.use_devices(config, RunOptions())
    began = time.perf_counter()
    trainer = make_trainer(make_task(config), 1, devices.make_mesh(count))
    state = trainer.init(config, seed_keys(config))
    state, _ = jax.block_until_ready(trainer.dispatch(config, state, 1))
    compiled = time.perf_counter() - began
    since, iterations = time.perf_counter(), 0
    while time.perf_counter() - since < seconds:
        state, _ = jax.block_until_ready(trainer.dispatch(config, state, 1))
        iterations += 1
    one = (time.perf_counter() - since) / iterations
    return Iteration(compiled - one, one, count)


def ours(config: ResolvedConfig, seconds: float) -> Row:
    """Measure one of our algorithms."""
    compiled, one, count = iteration(config, seconds)
    samples, alone = config.samples_per_iteration, parts_of(config, count, seconds / 10)
    best = samples / roofline(config)
    return Row(
        task=config.env,
        algo=config.algo,
        physics=config.physics,
        width=config.policy.hidden[0],
        num_envs=config.num_envs,
        devices=count,
        compile_seconds=compiled,
        steps_per_second=samples / one,
        roofline=best,
        parts=alone,
    )


class Pieces(NamedTuple):
    """Parts of an iteration, each with its arguments."""

    rollout: tuple[Callable, tuple]
    estimate: tuple[Callable, tuple]
    policy: tuple[Callable, tuple]
    critic: tuple[Callable, tuple]


def taken_apart(config: ResolvedConfig, count: int) -> Pieces:
    """Return the parts of the first iteration, the rollout on so many devices."""
    env, mesh = make_task(config), devices.make_mesh(count)
    algorithm = dg.make_algorithm(config.algo, env, config)
    init, _ = dg.make_train(algorithm, env, config)
    key = jax.random.key(0)
    state = jax.jit(init)(key)
    keys = jax.random.split(key, (config.num_steps, config.num_envs))

    @devices.shared_by(mesh)
    def roll(state, keys):
        return _roll_out(env, algorithm, state, keys, config.episode_length)

    def estimate(state, step):
        return _estimate(algorithm, state, step, step.reward, key, config)[0]

    step = jax.device_get(jax.jit(roll)(state, keys)[1])
    batch = jax.jit(estimate)(state, step)
    return Pieces(
        (roll, (state, keys)),
        (estimate, (state, step)),
        (algorithm.policy_update.step, (key, state.policy, batch)),
        (algorithm.critic_update.step, (key, state.critic, batch)),
    )


def parts_of(config: ResolvedConfig, count: int, seconds: float) -> dict[str, float]:
    """Return the milliseconds of each part alone; policy and critic on one device each."""
    found = {}
    for name, (f, args) in taken_apart(config, count)._asdict().items():
        part = jax.jit(f, compiler_options=COMPILER_OPTIONS)
        found[name] = 1e3 * fastest(functools.partial(part, *args), seconds)
    return found


def roofline(config: ResolvedConfig) -> float:
    """Return the seconds of an iteration of nothing but physics, matrix products and losses."""
    flops = sum(float(counted(f, "cpu")(*args)[1].flops) for f, args in _without_physics(config))
    seconds = c_seconds(config.env, config.num_envs, config.num_steps) + flops / product_rate()
    critic = config.critic
    if critic.is_distribution:
        targets = 1 if critic.target == "lambda-return" else critic.outputs
        errors = critic.fit["epochs"] * config.samples_per_iteration * critic.outputs * targets
        seconds += errors / (cores() * error_rate(critic.outputs))
    return seconds


def _without_physics(config: ResolvedConfig) -> list[tuple[Callable, tuple]]:
    """Return functions that act on all samples, estimate, and fit."""
    pieces = taken_apart(dataclasses.replace(config, physics="native"), 1)
    state, _ = pieces.rollout[1]
    actor, env = InferenceState(state.policy.params, state.obs_stats), make_task(config)
    act = sampler(make_policy(env, config), actor)
    keys, obs = jax.random.split(jax.random.key(0), config.num_envs), state.episodes.env.obs

    def act_on_all():
        def step(carry, _):
            return carry, act(keys, obs)[0]

        return jax.lax.scan(step, 0, None, length=config.num_steps)[1]

    return [(act_on_all, ()), *pieces[1:]]


@functools.cache
def c_seconds(task: str, envs: int, num_steps: int) -> float:
    """Return the seconds of C MuJoCo alone, on all cores, under random controls."""
    env: Any = dg.make_env(task, physics="native")
    model, rng = env.physics.model, np.random.default_rng(0)
    batch = Batch(model, envs, min(cores(), envs))
    batch.bind("qpos")[:] = model.qpos0

    def run() -> None:
        for _ in range(num_steps):
            batch.bind("ctrl")[:] = rng.uniform(-1, 1, (envs, model.nu))
            batch.step(nstep=env.FRAME_SKIP)

    return fastest(run, 2.0)


@functools.cache
def product_rate(size: int = 512) -> float:
    """Return flops per second of matrix products, which XLA divides between all cores."""
    x = jnp.ones((size, size))
    many = jax.jit(lambda x: jax.lax.fori_loop(0, 20, lambda i, y: jnp.tanh(y[:1]) + x @ y, x))
    return 20 * 2 * size**3 / fastest(lambda: many(x), 2.0)


@functools.cache
def error_rate(quantiles: int) -> float:
    """Return errors per second of the quantile-Huber loss with its gradients on one core."""
    x = jax.random.normal(jax.random.key(0), (64, quantiles))
    slopes = jax.grad(lambda z, t: dg.quantile_huber_loss(z, t).sum())
    many = jax.jit(
        lambda x: jax.lax.fori_loop(0, 100, lambda i, y: y - 1e-3 * slopes(y, x), 2 * x),
        compiler_options=COMPILER_OPTIONS,
    )
    return 100 * 64 * quantiles**2 / fastest(lambda: many(x), 1.0)


def settings(arguments: Arguments) -> Iterator[ResolvedConfig]:
    """Yield all of ours."""
    for task, width, physics, algo in itertools.product(
        arguments.tasks, arguments.widths, arguments.physics, arguments.algos
    ):
        yield setting(task, algo, physics, width)


def measured_peers(arguments: Arguments) -> Iterator[peers.Peer]:
    """Yield the peers in all layouts."""
    for task, width in itertools.product(arguments.tasks, arguments.widths):
        samples = {
            PEER_OF[algo]: setting(task, algo, "native", width).samples_per_iteration
            for algo in arguments.algos
        }
        yield from peers.all_of(task, width, arguments.seconds, samples)
        yield from peers_jax.all_of(task, width, arguments.seconds)


def main() -> None:
    """Print the peers, then a row of ours each, over the fastest peer and over the roofline."""
    arguments = tyro.cli(Arguments, description="Training throughput.")
    others: list[dict[str, Any]] = []
    for peer in measured_peers(arguments) if arguments.peers else ():
        others.append(dataclasses.asdict(peer))
        print(f"{peer.name:76s} {peer.steps_per_second:9,.0f}", flush=True)
    print(f"{cores()} cores, {jax.devices()[0].device_kind}, jax {jax.__version__}; parts in ms")
    print(f"{'task':7s} {'algo':5s} {'physics':7s} {'width':>5s} {'compile s':>9s}", end=" ")
    print(f"{'steps/s':>9s} {'/ peer':>7s} {'/ roofline':>10s}", end=" ")
    print(*(f"{name:>9s}" for name in Pieces._fields))
    rows = []
    for config in settings(arguments):
        # JAX starts with as many devices as the run has
        with multiprocessing.get_context("spawn").Pool(1) as process:
            row = process.apply(ours, (config, arguments.seconds))
        rows.append(dataclasses.asdict(row))
        rival, speed = rival_of(rows[-1], others), row.steps_per_second
        over = f"{speed / rival['steps_per_second']:7.1f}" if rival else f"{'':7s}"
        print(f"{row.task:7s} {row.algo:5s} {row.physics:7s} {row.width:5d}", end=" ")
        print(
            f"{row.compile_seconds:9.1f} {speed:9,.0f} {over} {speed / row.roofline:10.2f}", end=" "
        )
        print(*(f"{ms:9.1f}" for ms in row.parts.values()), flush=True)
    if arguments.json:
        machine = {**runtime.hardware(), "jax": jax.__version__}
        found = {"machine": machine, "ours": rows, "peers": others}
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
