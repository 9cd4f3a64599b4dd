"""Compile seconds and training steps per second on Hopper, ours and stable-baselines3's, side by side in one run.

    pip install -e ".[bench]" && python benchmarks/throughput.py

The same network (2 × 64, tanh), samples per iteration (2,048), epochs (10), minibatches (64 samples), observation and
reward normalisation. stable-baselines3 runs with one world, with our 16, and with 16 in processes, on one and on all
threads of torch; its fastest setting is the one to compare with. Nothing else should run on the machine meanwhile.
"""

import dataclasses
import itertools
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import gymnasium
import jax

from dgae_jax import Config
from dgae_jax.cli.arguments import parse
from dgae_jax.configs.build import make_task, make_trainer, seed_keys


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    seconds: float = 20.0
    """Time to measure each setting, after compilation [s]."""
    physics: tuple[str, ...] = ("native", "jax")
    """Engines of ours to measure."""
    peer: bool = True
    """Measure stable-baselines3 too."""


@dataclass(frozen=True)
class Row:
    """One measurement."""

    name: str
    compile_seconds: float
    steps_per_second: float


def ours(algo: str, physics: str, seconds: float) -> Row:
    """From nothing to the first iteration, then as many iterations as fit, 1 at a time."""
    config = dataclasses.replace(Config(), algo=algo, physics=physics)
    began = time.perf_counter()
    trainer = make_trainer(make_task(config), 1)
    state = trainer.init(config, seed_keys(config))
    state, _ = jax.block_until_ready(trainer.dispatch(config, state, 1))
    compiled = time.perf_counter() - began
    since, iterations = time.perf_counter(), 0
    while time.perf_counter() - since < seconds:
        state, _ = jax.block_until_ready(trainer.dispatch(config, state, 1))
        iterations += 1
    speed = iterations * config.samples_per_iteration / (time.perf_counter() - since)
    return Row(f"dgae_jax {algo}, {physics}, {config.num_envs} worlds", compiled - config.samples_per_iteration / speed, speed)


def peer(worlds: int, processes: bool, threads: int, seconds: float) -> Row:
    """stable-baselines3's PPO for as many iterations as fit, the first left out."""
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize  # pyright: ignore[reportMissingImports]

    class Clock(BaseCallback):
        ends: list[float] = []  # noqa: RUF012

        def _on_rollout_start(self) -> None:
            self.ends.append(time.perf_counter())

        def _on_step(self) -> bool:
            return len(self.ends) < 3 or self.ends[-1] - self.ends[1] < seconds

    torch.set_num_threads(threads)

    def world() -> gymnasium.Env:
        gymnasium.logger.min_level = gymnasium.logger.ERROR  # that v4 is not the newest version is known
        return gymnasium.make("Hopper-v4")

    vector = make_vec_env(world, worlds, vec_env_cls=SubprocVecEnv if processes else DummyVecEnv)
    env, clock = VecNormalize(vector), Clock()
    clock.ends = []
    model = PPO(
        "MlpPolicy", env, n_steps=2048 // worlds, batch_size=64, n_epochs=10, device="cpu",
        policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}},
    )  # fmt: skip
    model.learn(10**9, callback=clock)
    env.close()
    speed = 2048 * (len(clock.ends) - 2) / (clock.ends[-1] - clock.ends[1])
    where = "processes" if processes else "one process"
    return Row(f"stable-baselines3 PPO, {worlds} worlds in {where}, {threads} torch threads", 0.0, speed)


def settings(arguments: Arguments) -> Iterator[Callable[[], Row]]:
    """All measurements, to be made one after the other."""
    for physics, algo in itertools.product(arguments.physics, ("ppo", "dppo")):
        yield lambda algo=algo, physics=physics: ours(algo, physics, arguments.seconds)
    if arguments.peer:
        threads = sorted({1, os.cpu_count() or 1})
        for (worlds, processes), count in itertools.product(((1, False), (16, False), (16, True)), threads):
            yield lambda w=worlds, p=processes, c=count: peer(w, p, c, arguments.seconds)


def main() -> None:
    """Print a row per setting, then our speed over the peer's fastest."""
    arguments = parse(Arguments, "Training throughput on Hopper.")
    jax.config.update("jax_enable_compilation_cache", False)
    print(f"{os.cpu_count()} cores, {jax.devices()[0].device_kind}, jax {jax.__version__}")
    print(f"{'setting':66s} {'compile s':>9s} {'steps/s':>9s}")
    rows = []
    for measure in settings(arguments):
        row = measure()
        rows.append(row)
        print(f"{row.name:66s} {row.compile_seconds:9.1f} {row.steps_per_second:9,.0f}", flush=True)
    fastest = max((row for row in rows if row.name.startswith("stable")), key=lambda row: row.steps_per_second, default=None)
    if fastest:
        print(f"over the fastest of stable-baselines3 ({fastest.steps_per_second:,.0f} steps/s):")
        for row in rows:
            if row is not fastest and not row.name.startswith("stable"):
                print(f"{row.name:66s} {row.steps_per_second / fastest.steps_per_second:19.1f} ×")


if __name__ == "__main__":
    main()
