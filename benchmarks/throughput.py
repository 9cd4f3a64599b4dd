"""Training steps per second, ours and others', side by side in one run, and what the cores could do at best.

    pip install -e ".[bench]" && python benchmarks/throughput.py --json benchmarks/results/throughput.json

Everyone trains on the same task with the same network (tanh), samples per iteration, epochs, minibatches and normalisation.
stable-baselines3 and sb3-contrib run with 1, 8 and 16 worlds in one process, 8 and 16 in processes, on one and on all threads of
torch; the fastest setting is the one to compare with. Brax's and rejax's PPO run on our own `jax` engine. The roofline is the time
of an iteration in which all cores do nothing but simulate (C MuJoCo), multiply matrices (the operations that the program counts, at
the highest rate measured here) and evaluate the residuals of the quantile-Huber loss (at the rate measured here). Nothing else
should run on the machine meanwhile.
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
from mujoco.batch import Batch
from table import PEER_OF, rival_of
from turns import counted

import dgae_jax as dg
from dgae_jax.cli import parse
from dgae_jax.configs.config import Config
from dgae_jax.configs.resolved import resolve
from dgae_jax.learn import devices
from dgae_jax.learn.build import make_policy, make_task, make_trainer, seed_keys
from dgae_jax.learn.iteration import _estimate, _roll_out, acting, nothing
from dgae_jax.learn.parallel import COMPILER_OPTIONS
from dgae_jax.learn.types import InferenceState
from dgae_jax.physics.registry import cores
from dgae_jax.run import runtime
from dgae_jax.run.options import RunOptions


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

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
    worlds: int
    devices: int
    compile_seconds: float
    steps_per_second: float
    roofline: float
    """Steps per second at best."""
    parts: dict[str, float]
    """Each part run alone [ms]."""


def fastest(f: Callable[[], Any], seconds: float) -> float:
    """The shortest of the calls that fit into some time, after one that compiles [s]."""
    jax.block_until_ready(f())
    ends = [time.perf_counter()]
    while ends[-1] - ends[0] < seconds:
        jax.block_until_ready(f())
        ends.append(time.perf_counter())
    return min(b - a for a, b in itertools.pairwise(ends))


def setting(task: str, algo: str, physics: str, width: int) -> Config:
    """An algorithm as on Walker2d, on any task, with networks as wide as asked for; A2C takes one step per rollout of 8, as its peer."""
    config = dataclasses.replace(dg.preset("tuned", algo, "walker2d"), env=task)
    as_peer = PEER_OF[algo] == "A2C"
    steps = {"optimizer": "rmsprop", "epochs": 1, "minibatches": 1} if as_peer else {}
    policy, critic = (
        dataclasses.replace(part, hidden=(width, width), **steps)
        for part in (config.policy, config.critic)
    )
    num_steps = 8 if as_peer else config.num_steps
    return resolve(
        dataclasses.replace(
            config, physics=physics, num_steps=num_steps, policy=policy, critic=critic
        )
    )


class Iteration(NamedTuple):
    """What one iteration takes, and what came before the first."""

    compile_seconds: float
    seconds: float
    devices: int


def iteration(config: Config, seconds: float) -> Iteration:
    """From nothing to the first iteration, then as many iterations as fit, one per call."""
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


def ours(config: Config, seconds: float) -> Row:
    """One of our algorithms."""
    compiled, one, count = iteration(config, seconds)
    samples, alone = config.samples_per_iteration, parts_of(config, count, seconds / 10)
    best = samples / roofline(config)
    return Row(
        config.env, str(config.algo), str(config.physics), config.policy.hidden[0], config.num_envs, count, compiled, samples / one, best,
        alone,
    )  # fmt: skip


class Pieces(NamedTuple):
    """An iteration taken apart, and what each part is given."""

    rollout: tuple[Callable, tuple]
    estimate: tuple[Callable, tuple]
    policy: tuple[Callable, tuple]
    critic: tuple[Callable, tuple]


def taken_apart(config: Config, count: int) -> Pieces:
    """The parts of the first iteration, the rollout on so many devices."""
    env, mesh = make_task(config), devices.make_mesh(count)
    algorithm = dg.make_algorithm(str(config.algo), env, config)
    init, _ = dg.make_train(algorithm, env, config)
    key = jax.random.key(0)
    state = jax.jit(init)(key)
    keys = jax.random.split(key, (config.num_steps, config.num_envs))

    @devices.shared_by(mesh)
    def roll(state, keys):
        return _roll_out(env, algorithm, state, keys, config.episode_length)

    def estimate(state, step):
        return _estimate(
            algorithm, state, step, step.reward, key, config.gamma, config.gae_lambda, nothing
        )[0]

    step = jax.device_get(jax.jit(roll)(state, keys)[1])
    batch = jax.jit(estimate)(state, step)
    return Pieces(
        (roll, (state, keys)),
        (estimate, (state, step)),
        (algorithm.policy_update.step, (key, state.policy, batch)),
        (algorithm.critic_update.step, (key, state.critic, batch)),
    )


def parts_of(config: Config, count: int, seconds: float) -> dict[str, float]:
    """Milliseconds of each part when it runs alone; policy and critic on one device each."""
    found = {}
    for name, (f, args) in taken_apart(config, count)._asdict().items():
        part = jax.jit(f, compiler_options=COMPILER_OPTIONS)
        found[name] = 1e3 * fastest(functools.partial(part, *args), seconds)
    return found


def roofline(config: Config) -> float:
    """Seconds of an iteration on all cores if there were nothing but physics, matrix products and residuals."""
    flops = sum(float(counted(f, "cpu")(*args)[1].flops) for f, args in _without_physics(config))
    products = flops / product_rate()
    quantiles, fit = config.critic.quantiles, config.critic
    targets = 1 if fit.target == "lambda-return" else quantiles
    residuals = (
        (fit.epochs or 0) * config.samples_per_iteration * quantiles * targets
        if quantiles and targets
        else 0
    )
    return (
        c_seconds(config.env, config.num_envs, config.num_steps)
        + products
        + residuals / (cores() * residual_rate(quantiles or 1))
    )


def _without_physics(config: Config) -> list[tuple[Callable, tuple]]:
    """Acting on all samples, estimating, fitting."""
    pieces = taken_apart(dataclasses.replace(config, physics="native"), 1)
    state, _ = pieces.rollout[1]
    actor, env = InferenceState(state.policy.params, state.observations), make_task(config)
    act = acting(make_policy(env, config), actor)
    keys, obs = jax.random.split(jax.random.key(0), config.num_envs), state.episodes.env.obs
    draw = lambda: jax.lax.scan(
        lambda c, _: (c, act(keys, obs)[0]), 0, None, length=config.num_steps
    )[1]  # noqa: E731
    return [(draw, ()), *pieces[1:]]


@functools.cache
def c_seconds(task: str, worlds: int, num_steps: int) -> float:
    """C MuJoCo alone, on all cores, under random controls [s]."""
    env: Any = dg.make_env(task, physics="native")
    model, rng = env.physics.model, np.random.default_rng(0)
    batch = Batch(model, worlds, min(cores(), worlds))
    batch.bind("qpos")[:] = model.qpos0

    def run() -> None:
        for _ in range(num_steps):
            batch.bind("ctrl")[:] = rng.uniform(-1, 1, (worlds, model.nu))
            batch.step(nstep=env.FRAME_SKIP)

    return fastest(run, 2.0)


@functools.cache
def product_rate(size: int = 512) -> float:
    """Floating-point operations per second of matrix products, which XLA divides between all cores."""
    x = jnp.ones((size, size))
    many = jax.jit(lambda x: jax.lax.fori_loop(0, 20, lambda i, y: jnp.tanh(y[:1]) + x @ y, x))
    return 20 * 2 * size**3 / fastest(lambda: many(x), 2.0)


@functools.cache
def residual_rate(quantiles: int) -> float:
    """Residuals per second of the quantile-Huber loss with its derivatives on one core."""
    x = jax.random.normal(jax.random.key(0), (64, quantiles))
    slopes = jax.grad(lambda z, t: dg.quantile_huber_loss(z, t).sum())
    many = jax.jit(
        lambda x: jax.lax.fori_loop(0, 100, lambda i, y: y - 1e-3 * slopes(y, x), 2 * x),
        compiler_options=COMPILER_OPTIONS,
    )
    return 100 * 64 * quantiles**2 / fastest(lambda: many(x), 1.0)


def settings(arguments: Arguments) -> Iterator[Config]:
    """All of ours, one after the other."""
    for task, width, physics, algo in itertools.product(
        arguments.tasks, arguments.widths, arguments.physics, arguments.algos
    ):
        yield setting(task, algo, physics, width)


def main() -> None:
    """Print the peers, then a row of ours each, over the fastest peer and over the roofline."""
    arguments = parse.arguments(Arguments, description="Training throughput.")
    others = []
    if arguments.peers:
        for task, width in itertools.product(arguments.tasks, arguments.widths):
            samples = {
                PEER_OF[algo]: setting(task, algo, "native", width).samples_per_iteration
                for algo in arguments.algos
            }
            theirs = peers.all_of(task, width, arguments.seconds, samples)
            for measured in itertools.chain(
                theirs, peers_jax.all_of(task, width, arguments.seconds)
            ):
                others.append(measured)
                print(f"{measured.name:76s} {measured.steps_per_second:9,.0f}", flush=True)
    print(
        f"{cores()} cores, {jax.devices()[0].device_kind}, jax {jax.__version__}; milliseconds of each part alone"
    )
    head = f"{'task':7s} {'algo':5s} {'physics':7s} {'width':>5s} {'compile s':>9s} {'steps/s':>9s} {'/ peer':>7s} {'/ roofline':>10s}"
    print(head, *(f"{name:>9s}" for name in Pieces._fields))
    rows = []
    for config in settings(arguments):
        with multiprocessing.get_context("spawn").Pool(
            1
        ) as process:  # JAX starts with as many devices as the run has
            row = process.apply(ours, (config, arguments.seconds))
        rows.append(row)
        rival = rival_of(dataclasses.asdict(row), [dataclasses.asdict(o) for o in others])
        over = f"{row.steps_per_second / rival['steps_per_second']:7.1f}" if rival else f"{'':7s}"
        print(
            f"{row.task:7s} {row.algo:5s} {row.physics:7s} {row.width:5d} {row.compile_seconds:9.1f} {row.steps_per_second:9,.0f} {over}"
            f" {row.steps_per_second / row.roofline:10.2f}",
            *(f"{ms:9.1f}" for ms in row.parts.values()),
            flush=True,
        )
    if arguments.json:
        facts = {**runtime.hardware(), "jax": jax.__version__}
        found = {
            "machine": facts,
            "ours": [dataclasses.asdict(r) for r in rows],
            "peers": [dataclasses.asdict(o) for o in others],
        }
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
