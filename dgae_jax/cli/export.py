"""Use a policy elsewhere, or show it: `dgae export`, `dgae render` and `dgae figures`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dgae_jax.cli import parse
from dgae_jax.cli.evaluate import PolicyArguments, titles
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.envs.registry import TASKS, spec_of
from dgae_jax.export import gl
from dgae_jax.run import terminal


@dataclass(frozen=True, kw_only=True)
class ExportArguments(PolicyArguments):
    """Export a trained policy and its critic to export/FORMAT, for programs without JAX."""

    to: tuple[Literal["npz", "onnx", "gymnasium"], ...]
    """npz (NumPy alone), onnx (ONNX Runtime) and gymnasium (an agent without JAX)."""
    seed: tyro.conf.Suppress[int] = 0


@parse.command(ExportArguments)
def export(args: ExportArguments) -> None:
    """Export one policy."""
    if "onnx" in args.to:
        parse.require("onnx", "export")
    config = args.config_of(args.run_dir)
    if "gymnasium" in args.to and spec_of(config.env).eval_env() is None:
        raise invalid("to", "gymnasium", f"left out with {config.env}, which Gymnasium lacks")
    out, formats = args.out_or("export"), list(dict.fromkeys(args.to))
    with args.writing(out, config, "directory"):
        from dgae_jax.export import bundle

        written = bundle.export(args.run_dir, config, args.checkpoint, args.index, formats, out)
    for kind, names in written.items():
        terminal.say(f"written to {out / kind}: {', '.join(names)}")


@dataclass(frozen=True, kw_only=True)
class RenderArguments(PolicyArguments):
    """Make a video of the deterministic policy of a trained run, in Gymnasium.

    The files are video.mp4 and video.gif, or video-best, video-during and video-compare.
    """

    compare: tuple[Path, ...] = ()
    """Further runs from the same initial states, shown beside the first [paths]."""
    during: bool = False
    """Show the policy at each checkpoint that the run keeps, one after the other."""
    episodes: Annotated[int, parse.number(int, 1, 1000)] = 1
    """Episodes, one after the other [episodes]."""
    seconds: Annotated[float, parse.number(float, 0.001, 600)] = 10.0
    """Longest part of an episode that is shown, in simulated time [s]."""
    format: Literal["mp4", "gif", "both"] = "both"
    """Files to write."""
    width: Annotated[int, parse.number(int, 160, 1920)] = 480
    """Width of the picture of each robot, made even [pixels]."""
    height: Annotated[int, parse.number(int, 120, 1080)] = 360
    """Height of the picture of each robot without the overlay below it, made even [pixels]."""
    fps: Annotated[int, parse.number(int, 1, 100)] = 25
    """Frames per second of the MP4; a GIF has at most half of the default [1/s]."""

    @property
    def stem(self) -> Path:
        """The files to write, without their endings."""
        name = "video" + "-during" * self.during + "-compare" * bool(self.compare)
        out = self.out_or(name + "-best" * (self.checkpoint == "best"))
        return out.with_suffix("") if out.suffix in (".mp4", ".gif") else out


@parse.command(RenderArguments)
def render(args: RenderArguments) -> None:
    """Make a video of one run or several."""
    if args.during and (args.compare or args.checkpoint == "best" or args.run_dir.is_file()):
        others = "--compare, --checkpoint best or the file of a single policy"
        raise ConfigError(f"--during: cannot be combined with {others}")
    parse.require("imageio_ffmpeg", "video")
    sources = [args.run_dir, *args.compare]
    if any(path.is_file() for path in sources):
        gl.choose()  # reading a policy's file imports MuJoCo
    configs = [args.config_of(path) for path in sources]
    for path, config in zip(sources, configs, strict=True):
        if not spec_of(config.env).eval_envs:
            raise ConfigError(f"{path}: must be a run of {', '.join(TASKS)}, not {config.env}")
    formats = ("mp4", "gif") if args.format == "both" else (args.format,)
    gl.choose()
    file = args.stem.with_name(f"{args.stem.name}.{formats[0]}")
    with args.writing(file, configs[0]) as watch:
        from dgae_jax.export import video
        from dgae_jax.run.episodes import episode_seeds

        runs = list(zip(titles(sources), sources, configs, strict=True))
        actors = video.actors(runs, "all" if args.during else args.checkpoint, args.index)
        seeds = episode_seeds(args.seed, args.episodes)
        size = args.width // 2 * 2, args.height // 2 * 2
        frames = video.frames(actors, seeds, args.seconds, size, args.fps, watch)
        written = video.write(frames, args.stem, formats, args.fps)
    for path in written:
        terminal.say(f"written to {path} ({path.stat().st_size / 1e6:.1f} MB)")


FIGURES = {"robots": ("png",), "transport": ("png", "svg")}
"""The figures, each a function of `dgae_jax.export.figures`, and their files."""


@dataclass(frozen=True)
class FiguresArguments:
    """Draw the figures of the paper that need no training."""

    out: Path = Path("figures")
    """Directory to write, made if it is not there [path]."""
    only: Literal["robots", "transport"] | None = None
    """robots (Fig. 1) or transport (Fig. 2: the directional metric); by default both."""


@parse.command(FiguresArguments)
def figures(args: FiguresArguments) -> None:
    """Draw the figures."""
    names = [args.only] if args.only else list(FIGURES)
    if "robots" in names:
        gl.choose()
    from dgae_jax.export import figures

    with parse.writing(args.out, "directory"):
        args.out.mkdir(parents=True, exist_ok=True)
        for name in names:
            figure = getattr(figures, name)()
            for kind in FIGURES[name]:
                figures.save(figure, args.out / f"{name}.{kind}")
                terminal.say(f"written to {args.out / name}.{kind}")
