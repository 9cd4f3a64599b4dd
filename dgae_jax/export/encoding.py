"""Video files: MP4 and GIF, encoded by ffmpeg in one pass over the frames."""

import math
import subprocess
import tempfile
from collections.abc import Iterable
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import numpy as np

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import files

FORMATS = {"mp4": ("mp4",), "gif": ("gif",), "both": ("mp4", "gif")}
"""Suffixes of the files by the value of --format."""

MP4_QUALITY = "23"
"""Constant rate factor of x264; lower is better and larger."""

GIF_FPS = 12.5
"""Highest frame rate of a GIF, which counts in hundredths of a second."""

GIF_FILTER = (
    "fps={rate},scale='min(640,iw)':-1:flags=lanczos,split[a][b];"
    "[a]palettegen=max_colors=64[p];[b][p]paletteuse=dither=none"
)
"""At most 640 pixels wide; without dithering what stands still costs nothing."""


def check_installed() -> None:
    """Raise ConfigError, naming what to install, unless videos can be encoded here."""
    if find_spec("imageio_ffmpeg") is None:
        raise ConfigError('imageio-ffmpeg is not installed: pip install "dgae_jax[video]"')


def write(
    frames: Iterable[np.ndarray], stem: Path, formats: tuple[str, ...], fps: float
) -> list[Path]:
    """Write a video, each file complete or not at all.

    Args:
        frames: uint8 [H, W, 3], with H and W even.
        stem: the files' path without its suffix.
        formats: any of mp4, gif.
        fps: frames per second; a GIF leaves some out (`GIF_FPS`).

    Returns:
        The paths written.

    Raises:
        OSError: a file cannot be written.
        ValueError: there are no frames.
    """
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError("a video must have at least one frame")
    with tempfile.TemporaryDirectory() as directory:
        parts = {kind: Path(directory) / f"video.{kind}" for kind in formats}
        command = _command(first, fps, parts)
        with subprocess.Popen(command, stdin=subprocess.PIPE) as ffmpeg:
            for frame in chain([first], frames):
                ffmpeg.stdin.write(frame.tobytes())  # pyright: ignore[reportOptionalMemberAccess]
        if ffmpeg.returncode:
            raise RuntimeError(f"ffmpeg failed with exit code {ffmpeg.returncode}")
        for kind, part in parts.items():
            files.replace(stem.with_name(f"{stem.name}.{kind}"), part.read_bytes())
    return [stem.with_name(f"{stem.name}.{kind}") for kind in formats]


def _command(frame: np.ndarray, fps: float, paths: dict[str, Path]) -> list[str]:
    """Return the command that encodes raw frames of this one's shape from its standard input."""
    import imageio_ffmpeg

    height, width, _ = frame.shape
    size = ["-s", f"{width}x{height}", "-r", str(fps)]
    options = {
        "mp4": ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", MP4_QUALITY],
        "gif": ["-vf", GIF_FILTER.format(rate=fps / math.ceil(fps / GIF_FPS))],
    }
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", *size, "-i", "-"]
    for kind, path in paths.items():
        command += [*options[kind], str(path)]
    return command
