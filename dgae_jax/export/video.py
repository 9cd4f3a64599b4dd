"""Videos of trained policies: robots side by side, each over an overlay of its critic."""

import math
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from itertools import islice, zip_longest
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
from dgae_jax.run.episodes import episode_seeds, gymnasium_steps, make_eval_env
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


def of_runs(
    runs: list[tuple[str, Path, ResolvedConfig]], which: str, index: int, clip: Clip
) -> Iterator[list[Episode]]:
    """Play each initial state with the policies of all runs.

    Args:
        runs: title, source and configuration of each.
        which: the checkpoint, latest or best.
        index: which of the seeds that were trained together, from 0.
        clip: what is played.
    """
    actors = [
        _actor(title, checkpoint.load_networks(path, config, which), config, index)
        for title, path, config in runs
    ]
    yield from _play_all(actors, clip)


def of_checkpoints(
    path: Path, config: ResolvedConfig, index: int, clip: Clip
) -> Iterator[list[Episode]]:
    """Play the policy at each checkpoint that the run keeps, oldest first; see `of_runs`."""
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
    config = actor.config
    env = make_eval_env(config, config.episode_length + MAX_RETURN_STEPS)
    dt = env.unwrapped.dt
    shown = min(config.episode_length, max(1, math.floor(seconds / dt)))
    most = shown + steps_that_count(config.gamma)
    steps = list(islice(gymnasium_steps([env], actor.policy, [seed], _pose), most))
    env.close()
    qpos, qvel = map(np.stack, zip(*(step.snapshots[0] for step in steps[:shown]), strict=True))
    rewards = np.concatenate([step.reward for step in steps])
    followed = lambda_sum(jnp.asarray(rewards), jnp.full(len(rewards), config.gamma))
    obs = np.concatenate([step.obs for step in steps[:shown]])
    quantiles = np.sort(actor.policy.quantiles(obs.astype(np.float32)))
    return Episode(
        actor.title,
        config,
        dt,
        fell=len(steps) <= shown and bool(steps[-1].terminated[0]),
        qpos=qpos,
        qvel=qvel,
        total=np.cumsum([0.0, *rewards])[: len(qpos)],
        quantiles=quantiles,
        value=np.average(quantiles, -1, weights_of(config.metric, quantiles.shape[-1])),
        discounted=np.asarray(followed)[: len(qpos)] / actor.reward_std,
    )


def _pose(env: Any) -> tuple[np.ndarray, np.ndarray]:
    data = env.unwrapped.data
    return data.qpos.copy(), data.qvel.copy()


def frames(
    scenes: Iterable[list[Episode]], width: int, height: int, fps: float, watch: Watch = unwatched
) -> Iterator[Frame]:
    """Draw scenes one after the other, the episodes of each side by side, in simulated time.

    Args:
        scenes: from `of_runs` or `of_checkpoints`.
        width: of each robot's picture [pixels].
        height: without its overlay [pixels].
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
                    renderers[task] = stack.enter_context(
                        Renderer(*task, width=width, height=height)
                    )
                columns.append(_panels(episode, renderers[task], width, fps))
            for frame in side_by_side(columns, hold=round(HOLD * fps)):
                if count % REPORT_EVERY == 0:
                    watch(f"drawing episode {number}, frame {count:,}")
                count += 1
                yield frame


def states_shown(states: int, dt: float, fps: float) -> list[int]:
    """Return the state that each frame shows: the last to begin, of so many at intervals `dt`."""
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
