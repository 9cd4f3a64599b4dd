"""From frames to files: MP4 by the encoder that imageio-ffmpeg brings, GIF by Pillow, in one pass over the frames."""

import io
import math
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import files

FORMATS = {"mp4": ("mp4",), "gif": ("gif",), "both": ("mp4", "gif")}
"""The files that each choice writes, by their endings."""

QUALITY = 23
"""Constant rate factor of x264: lower is better and larger."""

GIF_FPS = 12.5
"""Most frames per second of a GIF, which counts in hundredths of a second."""

GIF_WIDTH = 640
"""Widest GIF [pixels]; a wider film is made smaller."""

GIF_BYTES = 2_000_000
"""A GIF that comes out larger is made again, worse."""

GIF_LADDER = ((1.0, 64, 1), (0.8, 48, 1), (0.65, 32, 1), (0.5, 32, 2), (0.4, 16, 3))
"""Scale, colours, and every how many frames are taken, from the best to the smallest."""


def check_extra() -> None:
    """Raise ConfigError, saying what to install, unless an MP4 can be encoded here."""
    for module, package in (("mediapy", "mediapy"), ("imageio_ffmpeg", "imageio-ffmpeg")):
        if find_spec(module) is None:
            raise ConfigError(
                f'{package} is not installed, which encodes videos: pip install "dgae_jax[video]", or use --format gif'
            )


def write(
    frames: Iterable[np.ndarray], stem: Path, formats: tuple[str, ...], fps: float
) -> list[Path]:
    """Write `stem`.mp4 and `stem`.gif, each whole or not at all, and name them. Frames [H, W, 3] are uint8, H and W even.

    Nothing is written before all is encoded. Raises OSError for a file that cannot be written, ValueError without frames.
    """
    frames, every, thumbnails = iter(frames), math.ceil(fps / GIF_FPS), []
    first = next(frames, None)
    if first is None:
        raise ValueError("a film has at least one frame")

    def noted() -> Iterator[np.ndarray]:
        for i, frame in enumerate(chain([first], frames)):
            if i % every == 0:
                thumbnails.append(_thumbnail(frame))
            yield frame

    encoded = {}
    if "mp4" in formats:
        encoded["mp4"] = _mp4(noted(), first.shape[:2], fps)
    else:
        deque(noted(), maxlen=0)
    if "gif" in formats:
        encoded["gif"] = gif(thumbnails, fps / every)
    paths = [stem.with_name(f"{stem.name}.{kind}") for kind in encoded]
    for path, data in zip(paths, encoded.values(), strict=True):
        files.replace(path, data)
    return paths


def _mp4(frames: Iterable[np.ndarray], shape: tuple[int, ...], fps: float) -> bytes:
    """ffmpeg writes a file of its own, because the index of an MP4 is moved to its front at the end."""
    import imageio_ffmpeg
    import mediapy

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "film.mp4"
        how: dict[str, Any] = {
            "fps": fps,
            "crf": QUALITY,
            "ffmpeg_args": ["-movflags", "+faststart"],
        }
        with mediapy.VideoWriter(path, (shape[0], shape[1]), **how) as writer:
            for frame in frames:
                writer.add_image(frame)
        return path.read_bytes()


def _thumbnail(frame: np.ndarray) -> Any:
    from PIL import Image

    image = Image.fromarray(frame)
    return _scaled(image, min(1.0, GIF_WIDTH / image.width))


def _scaled(image: Any, scale: float) -> Any:
    from PIL import Image

    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image if scale == 1 else image.resize(size, Image.Resampling.LANCZOS)


def gif(images: list[Any], fps: float, most: int = GIF_BYTES) -> bytes:
    """Pillow images as a GIF without end: the first step of the ladder whose file has at most `most` bytes, or the last."""
    data = b""
    for scale, colours, every in GIF_LADDER:
        data = _gif([_scaled(image, scale) for image in images[::every]], colours, fps / every)
        if len(data) <= most:
            break
    return data


def _gif(images: list[Any], colours: int, fps: float) -> bytes:
    """One palette for all frames, taken from some of them, and no dithering: what stands still costs nothing then.

    An octree keeps colours that few pixels have, those of the strip; median cut does not.
    """
    from PIL import Image

    some = images[:: max(1, len(images) // 8)]
    sheet = Image.new("RGB", (some[0].width, sum(image.height for image in some)))
    for i, image in enumerate(some):
        sheet.paste(image, (0, i * image.height))
    palette = sheet.quantize(colours, method=Image.Quantize.FASTOCTREE)
    first, *rest = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    out = io.BytesIO()
    first.save(
        out, "GIF", save_all=True, append_images=rest, duration=round(100 / fps) * 10, loop=0
    )
    return out.getvalue()
