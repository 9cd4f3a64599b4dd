"""Videos of trained policies: robots side by side, each over an overlay of its critic."""

import math
import warnings
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.export.overlay import Episode, Overlay
from dgae_jax.export.renderer import Renderer
from dgae_jax.maths.returns import lambda_sum
from dgae_jax.maths.risk import weights_of
from dgae_jax.run import checkpoint
from dgae_jax.run.api import Policy
from dgae_jax.run.calibration import MAX_RETURN_STEPS, steps_that_count
from dgae_jax.run.episodes import episode_seeds
from dgae_jax.run.options import eval_env_id
from dgae_jax.run.runtime import Watch, unwatched

HOLD = 0.6
"""Seconds for which the last frame of an episode stands."""

PER_ROW = 3
"""Most robots in one row; more are arranged in a square."""

REPORT_EVERY = 25
"""Frames between reports of progress."""

Frame = UInt8[np.ndarray, "H W 3"]


class Actor(NamedTuple):
    """A policy that plays."""

    title: str
    policy: Policy
    config: ResolvedConfig
    reward_std: float
    """Divisor of the critic's rewards."""


class Clip(NamedTuple):
    """The part of a policy's episodes that a video shows."""

    episodes: int
    seed: int
    """Of the initial states, as in an evaluation."""
    seconds: float
    """Longest part of an episode, in simulated time [s]."""


class Size(NamedTuple):
    """Even size of each robot's picture, without its overlay [pixels]."""

    width: int
    height: int


def of_runs(
    runs: list[tuple[str, Path, ResolvedConfig]], which: str, index: int, clip: Clip
) -> Iterator[list[Episode]]:
    """Play each initial state with the policies of all runs.

    Args:
        runs: title, directory and configuration of each.
        which: the checkpoint, latest or best.
        index: which of the seeds that were trained together, from 0.
        clip: what is played.

    Raises:
        ConfigError: as `checkpoint.load_networks`.
    """
    actors = [
        _actor(title, checkpoint.load_networks(path, config, which), config, index)
        for title, path, config in runs
    ]
    yield from _play_all(actors, clip)


def of_checkpoints(
    path: Path, config: ResolvedConfig, index: int, clip: Clip
) -> Iterator[list[Episode]]:
    """Play the policy at each checkpoint that the run keeps, oldest first."""
    for found in checkpoint.load_all_networks(path, config):
        samples = int(found.path.stem.removeprefix("steps_"))
        yield from _play_all([_actor(f"after {samples:,} samples", found, config, index)], clip)


def _actor(title: str, found: checkpoint.Networks, config: ResolvedConfig, index: int) -> Actor:
    policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
    std = checkpoint.reward_std(found.path, config)[index]
    return Actor(title, Policy(policy, critic, config), config, float(std))


def _play_all(actors: list[Actor], clip: Clip) -> Iterator[list[Episode]]:
    for seed in episode_seeds(clip.seed, clip.episodes):
        yield [play(actor, int(seed), clip.seconds) for actor in actors]


def play(actor: Actor, seed: int, seconds: float) -> Episode:
    """Play the episode that Gymnasium begins with this seed, up to its time limit or `seconds`.

    It continues beyond the states returned until rewards no longer count in their discounted
    returns, or the robot falls.
    """
    config, env = actor.config, _make_env(actor.config)
    shown = min(config.episode_length, max(1, math.floor(seconds / env.unwrapped.dt)))
    states, rewards, fell = _steps(env, actor.policy, seed, shown + steps_that_count(config.gamma))
    obs, qpos, qvel = (np.stack(part[:shown]) for part in zip(*states, strict=True))
    quantiles = np.sort(actor.policy.quantiles(obs))
    followed = lambda_sum(jnp.asarray(rewards), jnp.full(len(rewards), config.gamma))
    return Episode(
        actor.title,
        config,
        dt=env.unwrapped.dt,
        fell=fell and len(states) <= shown,
        qpos=qpos,
        qvel=qvel,
        total=np.cumsum([0.0, *rewards])[: len(qpos)],
        quantiles=quantiles,
        value=np.average(quantiles, -1, weights_of(config.metric, quantiles.shape[-1])),
        discounted=np.asarray(followed)[: len(qpos)] / actor.reward_std,
    )


def _make_env(config: ResolvedConfig) -> Any:
    import gymnasium

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that v4 is not the latest version is known
        return gymnasium.make(
            eval_env_id(config), max_episode_steps=config.episode_length + MAX_RETURN_STEPS
        )


def _steps(env: Any, policy: Policy, seed: int, most: int) -> tuple[list, list[float], bool]:
    data = env.unwrapped.data
    obs, _ = env.reset(seed=seed)
    states, rewards, fell = [], [], False
    while len(states) < most and not fell:
        states.append((obs, data.qpos.copy(), data.qvel.copy()))
        obs, reward, fell, _, _ = env.step(policy(obs))
        rewards.append(float(reward))
    env.close()
    return states, rewards, bool(fell)


def frames(
    scenes: Iterable[list[Episode]], size: Size, fps: float, watch: Watch = unwatched
) -> Iterator[Frame]:
    """Draw scenes one after the other, the episodes of each side by side, in simulated time.

    Args:
        scenes: from `of_runs` or `of_checkpoints`.
        size: of each robot's picture.
        fps: frames per second.
        watch: told how far it is.
    """
    with ExitStack() as stack:
        renderers: dict[tuple, Renderer] = {}
        count = 0
        for number, scene in enumerate(scenes, 1):
            columns = []
            for episode in scene:
                task = episode.config.env, episode.config.env_version
                if task not in renderers:
                    renderers[task] = stack.enter_context(Renderer(*task, **size._asdict()))
                columns.append(_panels(episode, renderers[task], size.width, fps))
            for frame in side_by_side(columns, hold=round(HOLD * fps)):
                if count % REPORT_EVERY == 0:
                    watch(f"drawing episode {number}, frame {count:,}")
                count += 1
                yield frame


def states_shown(states: int, dt: float, fps: float) -> list[int]:
    """Return the state that each frame shows, the last one that has begun.

    Args:
        states: how many there are.
        dt: between two of them [s].
        fps: frames per second.
    """
    frames = max(1, int(states * dt * fps + 1e-6))
    return [*(int(k / (fps * dt) + 1e-6) for k in range(frames - 1)), states - 1]


def side_by_side(columns: list[Iterator[Frame]], hold: int) -> Iterator[Frame]:
    """Yield frames of all columns; one that has ended stands still, at the end all for `hold`."""
    last: list[Frame] = []
    for row in zip_longest(*columns):
        last = [new if new is not None else old for new, old in zip(row, last or row, strict=True)]
        yield tile(last)
    for _ in range(hold):
        yield tile(last)


def tile(panels: list[Frame]) -> Frame:
    """Arrange panels in rows; the rest of the last row is white."""
    columns = len(panels) if len(panels) <= PER_ROW else math.ceil(math.sqrt(len(panels)))
    panels = [*panels, *[np.full_like(panels[0], 255)] * (-len(panels) % columns)]
    rows = [np.concatenate(panels[i : i + columns], axis=1) for i in range(0, len(panels), columns)]
    return np.concatenate(rows)


def _panels(episode: Episode, renderer: Renderer, width: int, fps: float) -> Iterator[Frame]:
    overlay = Overlay(episode, width)
    for t in states_shown(len(episode.qpos), episode.dt, fps):
        robot = renderer.render(episode.qpos[t], episode.qvel[t])
        yield np.concatenate([robot, overlay.render(t)])
