"""Video files: MP4 and GIF, encoded by ffmpeg in one pass over the frames."""

import math
import subprocess
import tempfile
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from dgae_jax.run import files

FORMATS = {"mp4": ("mp4",), "gif": ("gif",), "both": ("mp4", "gif")}
"""Suffixes of the files by the value of --format."""

GIF_FILTER = (
    "fps={rate},scale='min(640,iw)':-1:flags=lanczos,split[a][b];"
    "[a]palettegen=max_colors=64[p];[b][p]paletteuse=dither=none"
)
"""At most 640 pixels wide, without dithering: then what stands still costs nothing."""


def write(
    frames: Iterator[np.ndarray], stem: Path, formats: tuple[str, ...], fps: int
) -> list[Path]:
    """Write a video, each file complete or not at all.

    Args:
        frames: uint8 [H, W, 3], with H and W even.
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
