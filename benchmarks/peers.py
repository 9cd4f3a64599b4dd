"""Training steps per second of stable-baselines3 and sb3-contrib, in several layouts."""

# pyright: reportMissingImports=false

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium

from dgae_jax.envs.registry import TASKS
from dgae_jax.physics import cores


@dataclass(frozen=True)
class Peer:
    """One measurement of another library."""

    task: str
    algo: str
    width: int
    name: str
    steps_per_second: float


LAYOUTS = ((1, False), (8, False), (16, False), (8, True), (16, True))
"""Number of envs, and True for a process each."""


def all_of(task: str, width: int, seconds: float, samples: dict[str, int]) -> Iterator[Peer]:
    """Measure every algorithm in every layout, on one thread of torch and on one per core."""
    for algo, (envs, processes), threads in itertools.product(
        samples, LAYOUTS, sorted({1, cores()})
    ):
        speed = steps_per_second(
            task, algo, width, envs, processes, threads, samples[algo], seconds
        )
        where = "processes" if processes else "one process"
        layout = f"{envs} envs in {where}, {threads} threads"
        name = f"stable-baselines3 {algo}, {task}, 2 × {width}, {layout}"
        yield Peer(task, algo, width, name, speed)


def steps_per_second(
    task: str,
    algo: str,
    width: int,
    envs: int,
    processes: bool,
    threads: int,
    samples: int,
    seconds: float,
) -> float:
    """Time as many iterations as fit, without the first."""
    import torch
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

    ends: list[float] = []

    class Clock(BaseCallback):
        def _on_rollout_start(self) -> None:
            ends.append(time.perf_counter())

        def _on_step(self) -> bool:
            return len(ends) < 3 or ends[-1] - ends[1] < seconds

    torch.set_num_threads(threads)

    def make() -> gymnasium.Env:
        gymnasium.logger.min_level = gymnasium.logger.ERROR  # v4 is not the latest version
        return gymnasium.make(TASKS[task].eval_envs["v4"])

    vec_env_cls = SubprocVecEnv if processes else DummyVecEnv
    env = VecNormalize(make_vec_env(make, envs, vec_env_cls=vec_env_cls))
    _model(algo, env, width, samples // envs).learn(10**9, callback=Clock())
    env.close()
    return samples // envs * envs * (len(ends) - 2) / (ends[-1] - ends[1])


def _model(algo: str, env: Any, width: int, steps: int) -> Any:
    """The library's algorithm with our samples per iteration, minibatches and epochs."""
    from sb3_contrib import TRPO
    from stable_baselines3 import A2C, PPO

    common = {
        "n_steps": steps,
        "device": "cpu",
        "policy_kwargs": {"net_arch": {"pi": [width, width], "vf": [width, width]}},
    }
    if algo == "A2C":
        return A2C("MlpPolicy", env, **common)
    if algo == "TRPO":
        return TRPO("MlpPolicy", env, batch_size=64, n_critic_updates=10, cg_max_steps=10, **common)
    return PPO("MlpPolicy", env, batch_size=64, n_epochs=10, **common)
