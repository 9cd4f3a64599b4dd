"""Episodes of a trained policy in Gymnasium, with what its critic thought at every step and what came after."""

import math
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.maths.risk import weights_of
from dgae_jax.maths.transport import directional_metric
from dgae_jax.run import checkpoint
from dgae_jax.run.api import Policy
from dgae_jax.run.calibration import MAX_RETURN_STEPS, steps_that_count
from dgae_jax.run.evaluation import episode_seeds
from dgae_jax.run.options import eval_env_id


class Actor(NamedTuple):
    """Who plays."""

    title: str
    policy: Policy
    config: ResolvedConfig
    reward_std: float
    """What the critic's rewards are divided by."""


class Episode(NamedTuple):
    """The beginning of an episode, state by state before each action."""

    actor: Actor
    dt: float
    """Between two states [s]."""
    fell: bool
    """Whether the episode ended with the last state shown, because the robot was not healthy any more."""
    qpos: Float[np.ndarray, "T Q"]
    qvel: Float[np.ndarray, "T V"]
    total: Float[np.ndarray, " T"]
    """Undiscounted rewards so far."""
    quantiles: Float[np.ndarray, "T K"]
    """The critic's, sorted; a scalar critic has one."""
    value: Float[np.ndarray, " T"]
    """Of the quantiles, by the run's preference."""
    came: Float[np.ndarray, " T"]
    """The discounted return from each state on, of rewards scaled as the critic's."""


class Shots(NamedTuple):
    """What is played."""

    episodes: int
    seed: int
    """Decides the initial states, as in an evaluation."""
    seconds: float
    """Longest part of an episode that is shown, in its own time [s]."""


def of_runs(
    runs: list[tuple[str, Path, ResolvedConfig]], which: str, index: int, shots: Shots
) -> Iterator[list[Episode]]:
    """One list after the other, each of the same initial state played by all runs (title, directory, configuration).

    `index` is that among the seeds trained side by side. Raises as `restore.trained`.
    """
    cast = [
        _actor(title, checkpoint.load_networks(path, config, which), config, index)
        for title, path, config in runs
    ]
    yield from _played(cast, shots)


def of_checkpoints(
    path: Path, config: ResolvedConfig, index: int, shots: Shots
) -> Iterator[list[Episode]]:
    """The policy at each checkpoint that the run keeps, one after the other, oldest first. Raises as `restore.kept`."""
    for found in checkpoint.load_all_networks(path, config):
        samples = int(found.path.stem.removeprefix("steps_"))
        yield from _played([_actor(f"after {samples:,} samples", found, config, index)], shots)


def _actor(title: str, found: checkpoint.Networks, config: ResolvedConfig, index: int) -> Actor:
    policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
    return Actor(
        title,
        Policy(policy, critic, config),
        config,
        float(checkpoint.reward_std(found.path, config)[index]),
    )


def _played(cast: list[Actor], shots: Shots) -> Iterator[list[Episode]]:
    for number in episode_seeds(shots.seed, shots.episodes):
        yield [play(actor, int(number), shots.seconds) for actor in cast]


def play(actor: Actor, number: int, seconds: float) -> Episode:
    """The episode that Gymnasium begins with the seed `number`, up to its time limit or `seconds`.

    What is shown ends there; the episode goes on unseen until further rewards do not count in the return from the last state
    shown (`steps_that_count`), or the robot falls.
    """
    config, world = actor.config, _world(actor.config)
    shown = min(config.episode_length, max(1, math.floor(seconds / world.unwrapped.dt)))
    states, rewards, fell = _steps(
        world, actor.policy, number, shown + steps_that_count(config.gamma)
    )
    observed, qpos, qvel = (np.stack(part[:shown]) for part in zip(*states, strict=True))
    quantiles = np.sort(actor.policy.quantiles(observed))
    weights = weights_of(config.metric, quantiles.shape[-1])
    return Episode(
        actor,
        dt=world.unwrapped.dt,
        fell=fell and len(states) <= shown,
        qpos=qpos,
        qvel=qvel,
        total=np.cumsum([0.0, *rewards])[: len(qpos)],
        quantiles=quantiles,
        value=np.asarray(
            directional_metric(jnp.asarray(quantiles), jnp.zeros_like(quantiles), weights)
        ),
        came=returns_from(rewards, config.gamma)[: len(qpos)] / actor.reward_std,
    )


def returns_from(rewards: list[float], gamma: float) -> Float[np.ndarray, " T"]:
    """Σₖ γᵏ rₜ₊ₖ for every t."""
    out, after = np.zeros(len(rewards)), 0.0
    for t in reversed(range(len(rewards))):
        out[t] = after = rewards[t] + gamma * after
    return out


def _world(config: ResolvedConfig) -> Any:
    import gymnasium  # here, so that the module can be imported to look at its records

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that v4 is not the latest version is known
        return gymnasium.make(
            eval_env_id(config), max_episode_steps=config.episode_length + MAX_RETURN_STEPS
        )


def _steps(
    world: Any, policy: Callable[[Any], np.ndarray], number: int, longest: int
) -> tuple[list[tuple], list[float], bool]:
    """States (observation, qpos, qvel), the reward that followed each, and whether the last one was the end of the robot's health."""
    data = world.unwrapped.data
    obs, _ = world.reset(seed=number)
    states, rewards, fell = [], [], False
    while len(states) < longest and not fell:
        states.append((obs, data.qpos.copy(), data.qvel.copy()))
        obs, reward, fell, _, _ = world.step(policy(obs))
        rewards.append(float(reward))
    world.close()
    return states, rewards, bool(fell)
