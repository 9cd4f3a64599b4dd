"""Training steps per second of PPO in Brax and in rejax, on our tasks and engine."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from peers import Peer

import dgae_jax as dg

SAMPLES, EPOCHS, MINIBATCHES = 2048, 10, 32
"""Of an iteration."""


def all_of(task: str, width: int, seconds: float) -> Iterator[Peer]:
    """Measure each library in its layouts; print why one cannot run here."""
    for library, (measure, layouts) in LIBRARIES.items():
        for envs in layouts:
            name = f"{library} PPO, {task}, 2 × {width}, {envs} envs, `jax` physics"
            try:
                yield Peer(task, "PPO", width, name, measure(task, width, envs, seconds))
            except Exception as reason:
                print(
                    f"{name}: {type(reason).__name__}: {str(reason).partition(chr(10))[0][:120]}",
                    flush=True,
                )


class _Clock:
    """Iterations until the time is over, the first two left out."""

    def __init__(self, seconds: float):
        self.seconds, self.ends = seconds, []

    def tick(self) -> bool:
        """Return True if there is time for another."""
        self.ends.append(time.perf_counter())
        return len(self.ends) < 4 or self.ends[-1] - self.ends[1] < self.seconds

    def rate(self) -> float:
        """Samples per second."""
        return SAMPLES * (len(self.ends) - 2) / (self.ends[-1] - self.ends[1])


def brax(task: str, width: int, envs: int, seconds: float) -> float:
    """One training step of Brax per call, without evaluations."""
    from brax.training.agents.ppo import networks, train

    from dgae_jax.envs.brax import trainers

    class _Over(Exception):
        pass

    clock = _Clock(seconds)

    def progress(*_: Any) -> None:
        if not clock.tick():
            raise _Over

    make = partial(
        networks.make_ppo_networks,
        policy_hidden_layer_sizes=(width, width),
        value_hidden_layer_sizes=(width, width),
        activation=jnp.tanh,
    )
    iterations = 10_000  # its minibatches are whole unrolls
    with contextlib.suppress(_Over), trainers():
        train.train(
            dg.make_env(task),
            num_timesteps=iterations * SAMPLES,
            num_envs=envs,
            episode_length=1000,
            unroll_length=SAMPLES // MINIBATCHES,
            batch_size=1,
            num_minibatches=MINIBATCHES,
            num_updates_per_batch=EPOCHS,
            normalize_observations=True,
            network_factory=make,
            num_evals=iterations + 1,
            run_evals=False,
            progress_fn=progress,
            max_devices_per_host=1,
        )
    return clock.rate()


def rejax(task: str, width: int, envs: int, seconds: float) -> float:
    """One training iteration of rejax per call."""
    from rejax import PPO  # pyright: ignore[reportMissingImports]
    from rejax.compat.brax2gymnax import Brax2GymnaxEnv  # pyright: ignore[reportMissingImports]

    env: Any = dg.make_env(task)
    env.episode_length = 1000
    algo = PPO.create(
        env=Brax2GymnaxEnv(env),
        agent_kwargs={"hidden_layer_sizes": (width, width), "activation": "tanh"},
        num_envs=envs,
        num_steps=SAMPLES // envs,
        num_epochs=EPOCHS,
        num_minibatches=MINIBATCHES,
        normalize_observations=True,
        normalize_rewards=True,
        total_timesteps=10**6,
    )
    state, step = jax.jit(algo.init_state)(jax.random.key(0)), jax.jit(algo.train_iteration)
    clock = _Clock(seconds)
    while True:
        state = jax.block_until_ready(step(state))
        if not clock.tick():
            return clock.rate()


LIBRARIES: dict[str, tuple[Callable[..., float], tuple[int, ...]]] = {
    "Brax": (brax, (16, 32)),
    "rejax": (rejax, (16, 64)),
}
"""Functions and numbers of envs, of which Brax's minibatches must be a multiple."""

if __name__ == "__main__":
    for found in all_of("hopper", 64, 5.0):
        print(dataclasses.asdict(found), flush=True)
