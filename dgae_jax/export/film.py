"""From episodes to the frames of a film: robots side by side, each over its strip."""

import math
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from dgae_jax.export.episodes import Episode
from dgae_jax.export.stage import Stage
from dgae_jax.export.strip import Strip
from dgae_jax.run.runtime import Watch, unwatched

HOLD = 0.6
"""Seconds for which the last frame of an episode stands."""

IN_A_ROW = 3
"""Most robots in one row; more are arranged in a square."""

SAY_EVERY = 25
"""Frames between words on how far the film is."""

Frame = UInt8[np.ndarray, "H W 3"]


class Size(NamedTuple):
    """Of the picture of each robot [pixels], without its strip; even, as the encoding wants them."""

    width: int
    height: int


def film(
    scenes: Iterable[list[Episode]], size: Size, fps: float, watch: Watch = unwatched
) -> Iterator[Frame]:
    """The frames, in the episodes' own time: scenes one after the other, the episodes of each side by side."""
    with ExitStack() as stack:
        stages: dict[tuple, Stage] = {}
        count = 0
        for number, scene in enumerate(scenes, 1):
            for episode in scene:
                key = _stage_of(episode)
                if key not in stages:
                    stages[key] = stack.enter_context(
                        Stage(*key, width=size.width, height=size.height)
                    )
            for frame in side_by_side(
                [_panels(each, stages[_stage_of(each)], size, fps) for each in scene],
                round(HOLD * fps),
            ):
                if count % SAY_EVERY == 0:
                    watch(f"drawing episode {number}, frame {count:,}")
                count += 1
                yield frame


def shown(states: int, dt: float, fps: float) -> list[int]:
    """The state that each frame shows, of so many that are `dt` seconds apart: the last that has begun; of all in the last frame."""
    frames = max(1, int(states * dt * fps + 1e-6))
    return [*(int(k / (fps * dt) + 1e-6) for k in range(frames - 1)), states - 1]


def side_by_side(columns: list[Iterator[Frame]], hold: int) -> Iterator[Frame]:
    """One frame of each column; a column that has ended stands still, and so do all for `hold` frames at the end."""
    last: list[Frame] = []
    for row in zip_longest(*columns):
        last = [new if new is not None else old for new, old in zip(row, last or row, strict=True)]
        yield arranged(last)
    for _ in range(hold):
        yield arranged(last)


def arranged(panels: list[Frame]) -> Frame:
    """All panels in one picture, by rows; what is left of the last row is white."""
    columns = len(panels) if len(panels) <= IN_A_ROW else math.ceil(math.sqrt(len(panels)))
    panels = [*panels, *[np.full_like(panels[0], 255)] * (-len(panels) % columns)]
    rows = [np.concatenate(panels[i : i + columns], axis=1) for i in range(0, len(panels), columns)]
    return np.concatenate(rows)


def _stage_of(episode: Episode) -> tuple[str, str | None]:
    config = episode.actor.config
    return config.env, config.env_version


def _panels(episode: Episode, stage: Stage, size: Size, fps: float) -> Iterator[Frame]:
    strip = Strip(episode, size.width)
    for t in shown(len(episode.qpos), episode.dt, fps):
        yield np.concatenate([stage.picture(episode.qpos[t], episode.qvel[t]), strip.picture(t)])
