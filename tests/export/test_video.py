"""Videos: from episodes to frames, from frames to files, and `dgae render`."""

import dataclasses
import re
import subprocess
import sys
import warnings

import gymnasium
import imageio_ffmpeg
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageSequence

from dgae_jax.export import overlay, video
from dgae_jax.export.overlay import Episode, Overlay
from dgae_jax.export.video import Actor, play, side_by_side, states_shown
from tests.export.conftest import make_untrained
from tests.helpers import ROOT
from tests.runs import QUIET, small


class Constant:
    """A policy that holds one action, with a critic of four crossing quantiles."""

    def __init__(self, action):
        self.action = np.array(action, np.float32)

    def __call__(self, obs):
        return np.broadcast_to(self.action, (len(obs), len(self.action)))

    def quantiles(self, obs):
        return np.broadcast_to(np.array([3.0, 1.0, 4.0, 2.0], np.float32), (len(obs), 4))


def actor(env="hopper", action=(0.1, -0.2, 0.3), **changes):
    settings = {"env": env, "gamma": 0.9, "episode_length": 1000, **changes}
    config = dataclasses.replace(small("dppo"), **settings)
    return Actor("name", Constant(action), config, reward_std=2.0)


def gymnasiums_own(env, action, seed, steps):
    """Rewards and positions of the same episode."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gymnasium.make(env, max_episode_steps=10_000)
    env.reset(seed=seed)
    rewards, qpos, terminated = [], [], False
    while len(rewards) < steps and not terminated:
        qpos.append(env.unwrapped.data.qpos.copy())
        _, reward, terminated, _, _ = env.step(np.array(action, np.float32))
        rewards.append(reward)
    return np.array(rewards), np.array(qpos)


@pytest.mark.parametrize(
    ("env", "action", "gamma", "limit", "shown", "followed"),
    [
        ("hopper", (0.1, -0.2, 0.3), 0.9, 1000, None, 44),  # falls
        ("swimmer", (0.5, -0.5), 0.9, 1000, 10, 44),  # the first k with gamma**k <= 1 %
        ("swimmer", (0.5, -0.5), 0.999, 100, 1, 4603),
    ],
)
def test_episode_is_gymnasiums_with_the_returns_that_follow(
    env, action, gamma, limit, shown, followed
):
    playing = actor(env, action, gamma=gamma, episode_length=limit)
    episode = play(playing, 7, (shown or 250) * 0.04 + 1e-6)
    rewards, qpos = gymnasiums_own(f"{env.capitalize()}-v4", action, 7, (shown or 1000) + followed)
    shown = shown or len(rewards)
    assert 0 < shown < 1000
    assert_array_equal(episode.qpos, qpos[:shown])
    assert_allclose(episode.total, (np.cumsum(rewards) - rewards)[:shown])
    expected = [sum(gamma**k * r for k, r in enumerate(rewards[t:])) / 2 for t in range(shown)]
    assert_allclose(episode.discounted, expected, rtol=1e-4)
    assert_array_equal(episode.quantiles, [[1, 2, 3, 4]] * shown)


def test_a_frame_shows_the_last_state_that_has_begun():
    assert states_shown(10, dt=0.1, fps=5) == [0, 2, 4, 6, 9]
    assert states_shown(4, dt=0.05, fps=40) == [0, 0, 1, 1, 2, 2, 3, 3]
    assert states_shown(1000, dt=0.008, fps=25)[-2:] == [990, 999]
    assert states_shown(1, dt=0.008, fps=25) == states_shown(1, dt=0.05, fps=20) == [0]


def test_a_column_that_has_ended_stands_still():
    short, long = ([np.full((2, 64, 3), i, np.uint8) for i in range(n)] for n in (2, 4))
    rows = list(side_by_side([iter(short), iter(long)], hold=2))
    assert_array_equal([row[:, :64] for row in rows], [short[0], *[short[1]] * 5])
    assert_array_equal([row[:, 64:] for row in rows], [*long, long[3], long[3]])


def read_video(path):
    """Frames [F, H, W, 3] of an MP4, and its frames per second."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo"]
    done = subprocess.run([*command, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    stream = re.search(r"Video: .*?, (\d+)x(\d+).*? ([\d.]+) fps", done.stderr.decode())
    width, height, fps = map(float, stream.groups())
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, int(height), int(width), 3), fps


def length(path):
    """Return the duration of a GIF [ms]."""
    with Image.open(path) as gif:
        return sum(frame.info["duration"] for frame in ImageSequence.Iterator(gif))


def test_files_have_the_frames_and_the_speed_given(tmp_path):
    picture, fps = np.zeros((48, 64, 3), np.uint8), 10
    picture[:, :32] = (0, 114, 178)
    pictures = [np.roll(picture, 4 * i, axis=1) for i in range(10)]
    paths = video.write(iter(pictures), tmp_path / "a.b", ("mp4", "gif"), fps)
    assert paths == [tmp_path / "a.b.mp4", tmp_path / "a.b.gif"]
    frames, speed = read_video(paths[0])
    assert (frames.shape, speed) == ((10, 48, 64, 3), fps)
    assert np.abs(frames.astype(int) - pictures).mean() < 8
    assert length(paths[1]) == pytest.approx(10_000 / fps, abs=50)
    with Image.open(paths[1]) as gif:
        assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - pictures[0]).mean() < 8


SPREAD = np.linspace(0, 4, 64)


def episode_of(quantiles, metric="mean"):
    """Three states; the return that followed rises from the lowest to the highest quantile."""
    z = np.sort(np.asarray(quantiles, float))
    return Episode(
        title="name",
        metric=metric,
        dt=0.5,
        qpos=np.zeros((3, 6)),
        total=np.array([0.0, 10.0, 1234.0]),
        quantiles=np.stack([z, z + 1, z + 2]),
        discounted=np.linspace(z.min(), z.max() + 2, 3),
    )


def columns_of(picture, color):
    """Columns of an overlay that hold about this color, below the legend."""
    rgb = np.array([int(overlay.COLORS[color][i : i + 2], 16) for i in (1, 3, 5)])
    return np.flatnonzero((np.abs(picture[45:95].astype(int) - rgb).max(-1) < 40).any(0))


def test_overlay_moves_and_depends_on_the_state_alone():
    drawn = Overlay(episode_of(SPREAD), 480)
    pictures = [drawn.render(t) for t in range(3)]
    assert {picture.shape for picture in pictures} == {(overlay.HEIGHT, 480, 3)}
    assert_array_equal(drawn.render(0), pictures[0])
    at = [columns_of(picture, "vermilion") for picture in pictures]
    assert at[0].max() < at[1].min() <= at[1].max() < at[2].min()


def test_rug_shows_the_weights_of_the_risk_measure():
    neutral, averse = (
        columns_of(Overlay(episode_of(SPREAD, metric), 480).render(1), "blue")
        for metric in ("mean", "cvar:0.25")
    )
    assert np.ptp(averse) == pytest.approx(0.25 * np.ptp(neutral), abs=0.06 * np.ptp(neutral))
    assert averse.min() == neutral.min()


WIDTH, HEIGHT, FPS = 200, 120, 25


def render(*argv):
    """`dgae render` in a process of its own, which has OpenGL."""
    size = ["--width", WIDTH, "--height", HEIGHT, "--cache-dir", QUIET.cache_dir]
    done = subprocess.run(
        [sys.executable, "experiments/render.py", *map(str, [*argv, *size])],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_video_of_two_runs_side_by_side(trained, tmp_path, opengl):
    scalar = make_untrained("scalar", tmp_path).file
    out = tmp_path / "out"
    out.mkdir()
    said = render(trained, "--compare", scalar, "--episodes", 2, "--out", out / "v.mp4")
    assert re.findall(r"written to (.*) \(.* MB\)\n", said) == [f"{out}/v.mp4", f"{out}/v.gif"]
    frames, fps = read_video(out / "v.mp4")
    states = 20  # the small run's episodes are truncated there: 4 frames, and 15 at the end of each
    count = 2 * (int(states * 0.008 * FPS) + 15)
    assert (fps, frames.shape) == (FPS, (count, HEIGHT + overlay.HEIGHT, 2 * WIDTH, 3))
    robot, below = frames[:, :HEIGHT, :WIDTH].astype(int), frames[:, HEIGHT:].astype(int)
    assert np.abs(robot[3] - robot[0]).max() > 60
    assert np.abs(below[3] - below[0]).max() > 60
    assert length(out / "v.gif") == pytest.approx(19 * 80, abs=80)


def test_video_of_all_checkpoints(trained, tmp_path, opengl):
    render(trained, "--during", "--format", "gif", "--out", tmp_path / "video")
    assert length(tmp_path / "video.gif") == pytest.approx(2 * 19 * 40, abs=80)
