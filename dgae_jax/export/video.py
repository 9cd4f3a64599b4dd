"""Videos of trained policies: robots side by side, each over an overlay of its critic."""

import math
import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.export.overlay import Episode, Overlay
from dgae_jax.export.renderer import Renderer
from dgae_jax.maths.returns import lambda_sum
from dgae_jax.run import checkpoint, files
from dgae_jax.run.api import Policy
from dgae_jax.run.calibration import MAX_RETURN_STEPS, steps_that_count
from dgae_jax.run.episodes import gymnasium_steps, make_eval_env
from dgae_jax.run.runtime import Watch, unwatched

Frame = UInt8[np.ndarray, "H W 3"]

GIF_FILTER = (
    "fps={rate},scale='min(640,iw)':-1:flags=lanczos,split[a][b];"
    "[a]palettegen=max_colors=64[p];[b][p]paletteuse=dither=none"
)
"""At most 640 pixels wide, without dithering: then what stands still costs nothing."""


class Actor(NamedTuple):
    """A policy that plays."""

    title: str
    policy: Policy
    config: ResolvedConfig
    reward_std: float
    """Divisor of the critic's rewards."""


def actors(
    runs: Sequence[tuple[str, Path, ResolvedConfig]], which: str, index: int
) -> Iterator[list[Actor]]:
    """Yield policies that play the same initial states, side by side.

    Args:
        runs: title, source and configuration of each run.
        which: the checkpoint, latest or best; or all that the first run keeps, one after the other.
        index: which of the seeds that were trained together, from 0.
    """

    def actor(title: str, found: checkpoint.Networks, config: ResolvedConfig) -> Actor:
        policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
        std = checkpoint.reward_std(found.path, config)[index]
        return Actor(title, Policy(policy, critic, config), config, float(std))

    if which == "all":
        _, path, config = runs[0]
        for found in reversed(list(checkpoint.networks_in(path, config))):
            samples = int(found.path.stem.removeprefix("steps_"))
            yield [actor(f"after {samples:,} samples", found, config)]
    else:
        yield [
            actor(title, checkpoint.load_networks(path, config, which), config)
            for title, path, config in runs
        ]


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
    qpos = []

    def act(obs: np.ndarray) -> np.ndarray:
        qpos.append(env.unwrapped.data.qpos.copy())
        return actor.policy(obs)

    steps = list(islice(gymnasium_steps([env], act, [seed]), most))
    env.close()
    rewards = np.concatenate([step.reward for step in steps])
    followed = lambda_sum(jnp.asarray(rewards), jnp.full(len(rewards), config.gamma))
    obs = np.concatenate([step.obs for step in steps[:shown]])
    return Episode(
        actor.title,
        config.metric,
        dt,
        qpos=np.stack(qpos[:shown]),
        total=np.cumsum([0.0, *rewards])[: len(obs)],
        quantiles=np.sort(actor.policy.quantiles(obs.astype(np.float32))),
        discounted=np.asarray(followed)[: len(obs)] / actor.reward_std,
    )


def frames(
    casts: Iterable[list[Actor]],
    seeds: Sequence[int] | np.ndarray,
    seconds: float,
    size: tuple[int, int],
    fps: float,
    watch: Watch = unwatched,
) -> Iterator[Frame]:
    """Draw each cast in each initial state, one after the other, in simulated time.

    Args:
        casts: from `actors`.
        seeds: of the initial states, as `episode_seeds` returns them.
        seconds: longest part of an episode, in simulated time [s].
        size: width and height of each robot's picture, without its overlay [pixels].
        fps: frames per second.
        watch: told how far it is.
    """
    for cast in casts:
        for number, seed in enumerate(seeds, 1):
            watch(f"drawing episode {number} of {', '.join(actor.title for actor in cast)}")
            columns = [_panels(actor, play(actor, int(seed), seconds), size, fps) for actor in cast]
            yield from side_by_side(columns, hold=round(0.6 * fps))


def _panels(actor: Actor, episode: Episode, size: tuple[int, int], fps: float) -> Iterator[Frame]:
    """Draw one episode, the robot above its overlay."""
    config, overlay = actor.config, Overlay(episode, size[0])
    with Renderer(config.env, config.env_version, *size) as renderer:
        for t in states_shown(len(episode.qpos), episode.dt, fps):
            yield np.concatenate([renderer.draw(episode.qpos[t]), overlay.render(t)])


def states_shown(states: int, dt: float, fps: float) -> list[int]:
    """Return the state that each frame shows: the last to begin, of so many at intervals `dt`."""
    frames = max(1, int(states * dt * fps + 1e-6))
    return [*(int(k / (fps * dt) + 1e-6) for k in range(frames - 1)), states - 1]


def side_by_side(columns: list[Iterator[Frame]], hold: int) -> Iterator[Frame]:
    """Yield frames of all columns; one that has ended stands still, at the end all for `hold`."""
    last: list[Frame] = []
    for row in zip_longest(*columns):
        last = [new if new is not None else old for new, old in zip(row, last or row, strict=True)]
        yield np.concatenate(last, axis=1)
    for _ in range(hold):
        yield np.concatenate(last, axis=1)


def write(frames: Iterator[Frame], stem: Path, formats: tuple[str, ...], fps: int) -> list[Path]:
    """Write a video, each file complete or not at all.

    Args:
        frames: of even height and width.
        stem: the files' path without its suffix.
        formats: any of mp4, gif.
        fps: frames per second; a GIF has at most 12.5.

    Returns:
        The paths written.

    Raises:
        OSError: a file cannot be written.
    """
    import imageio_ffmpeg

    first = next(frames)
    height, width, _ = first.shape
    options = {
        "mp4": ["-c:v", "libx264", "-pix_fmt", "yuv420p"],
        "gif": ["-vf", GIF_FILTER.format(rate=fps / math.ceil(fps / 12.5))],
    }
    paths = [stem.with_name(f"{stem.name}.{kind}") for kind in formats]
    # not imageio_ffmpeg.write_frames, which forks: JAX warns of that
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
    with tempfile.TemporaryDirectory() as directory:
        parts = [Path(directory) / f"video.{kind}" for kind in formats]
        for kind, part in zip(formats, parts, strict=True):
            command += [*options[kind], str(part)]
        with subprocess.Popen(command, stdin=subprocess.PIPE) as ffmpeg:
            for frame in chain([first], frames):
                ffmpeg.stdin.write(frame.tobytes())  # pyright: ignore[reportOptionalMemberAccess]
        for part, path in zip(parts, paths, strict=True):
            files.replace(path, part.read_bytes())
    return paths
