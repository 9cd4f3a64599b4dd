"""Make a video of a trained run, `dgae render RUN_DIR`, and draw figures, `dgae figures`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dgae_jax.cli import parse
from dgae_jax.cli.evaluate import Choice
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import TASKS, spec_of
from dgae_jax.export import encoding, gl
from dgae_jax.run import files, terminal

MAX_SECONDS = 600.0
"""Longest part of an episode [s]."""


@dataclass(frozen=True, kw_only=True)
class RenderArguments(Choice):
    """Make a video of the deterministic policy of a trained run, in Gymnasium.

    Examples:
      dgae render runs/walker
      dgae render runs/walker --compare runs/hopper --seconds 5 --format gif
      dgae render runs/walker --during --out walker.mp4 --format mp4
    """

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or the file of dgae refit [path]."""
    compare: tuple[Path, ...] = ()
    """Further runs from the same initial states, next to each other, in a square from four on
    [paths]."""
    during: bool = False
    """Show the policy at each checkpoint that the run keeps, one after the other."""
    episodes: int = 1
    """Episodes, one after the other [episodes]."""
    seconds: float = 10.0
    """Longest part of an episode that is shown, in simulated time [s]."""
    format: Literal["mp4", "gif", "both"] = "both"
    """Files to write."""
    width: int = 480
    """Width of the picture of each robot, even [pixels]."""
    height: int = 360
    """Height of the picture of each robot without the overlay below it, even [pixels]."""
    fps: int = 25
    """Frames per second of the MP4; a GIF has at most half of the default [1/s]."""
    out: Path | None = None
    """File to write, without .mp4 and .gif; by default video in the run directory,
    video-best, video-during or video-compare [path]."""

    @property
    def sources(self) -> list[Path]:
        """All runs that are shown."""
        return [self.run_dir, *self.compare]

    @property
    def stem(self) -> Path:
        """The file to write, without its ending."""
        if self.out is not None:
            return self.out.with_suffix("") if self.out.suffix in (".mp4", ".gif") else self.out
        is_best = self.checkpoint == "best"
        kinds = {"during": self.during, "compare": bool(self.compare), "best": is_best}
        name = "-".join(["video", *(kind for kind, is_so in kinds.items() if is_so)])
        return files.beside(self.run_dir, name)


def _check(args: RenderArguments) -> list[ResolvedConfig]:
    """Return the configurations of the runs; raise ConfigError for the first mistake."""
    parse.check(args, episodes=(1, 1000), width=(160, 1920), height=(120, 1080), fps=(1, 100))
    for name in ("width", "height"):
        if getattr(args, name) % 2:
            raise invalid(name, getattr(args, name), "an even number")
    if not 0 < args.seconds <= MAX_SECONDS:
        raise invalid("seconds", args.seconds, f"a number above 0, up to {MAX_SECONDS:g}")
    if args.during and args.compare:
        raise invalid("compare", args.compare, "left out with --during, which shows one run")
    if args.during and args.checkpoint == "best":
        raise invalid("checkpoint", "best", "left out with --during, which shows every checkpoint")
    if args.during and args.run_dir.is_file():
        raise ConfigError(f"--during: must be left out with {args.run_dir}, a single policy")
    encoding.check_installed()
    if any(path.is_file() for path in args.sources):
        gl.choose()  # reading a policy's file imports MuJoCo
    configs = [args.config(path) for path in args.sources]
    for path, config in zip(args.sources, configs, strict=True):
        if not spec_of(config.env).eval_envs:
            raise ConfigError(f"{path}: must be a run of {', '.join(TASKS)}, not {config.env}")
    for kind in encoding.FORMATS[args.format]:
        parse.check_file(args.stem.with_name(f"{args.stem.name}.{kind}"))
    return configs


@parse.command(RenderArguments)
def render(args: RenderArguments) -> None:
    """Make a video of one run or several."""
    configs = _check(args)
    gl.choose()
    from dgae_jax.export import video

    parse.use_one_device(configs[0], args.cache_dir)
    clip = video.Clip(args.episodes, args.seed, args.seconds)
    if args.during:
        scenes = video.of_checkpoints(args.run_dir, configs[0], args.index, clip)
    else:
        runs = list(zip(_titles(args.sources), args.sources, configs, strict=True))
        scenes = video.of_runs(runs, args.checkpoint, args.index, clip)
    with terminal.Reporter() as reporter:
        frames = video.frames(scenes, args.width, args.height, args.fps, reporter.watch)
        with parse.writing(args.stem):
            written = encoding.write(frames, args.stem, encoding.FORMATS[args.format], args.fps)
    for path in written:
        terminal.say(f"written to {path} ({path.stat().st_size / 1e6:.1f} MB)")


def _titles(paths: list[Path]) -> list[str]:
    """Return the names of the runs; their whole paths where two names are the same."""
    names = [path.resolve().name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


FIGURES = {"robots": ("png",), "transport": ("png", "svg")}
"""The figures, each a function of `dgae_jax.export.figures`, and their files."""


@dataclass(frozen=True)
class FiguresArguments:
    """Draw the figures of the paper that need no training.

    Examples:
      dgae figures
      dgae figures --only transport
      dgae figures --only robots --out docs/images
    """

    out: Path = Path("figures")
    """Directory to write, made if it is not there [path]."""
    only: Literal["robots", "transport"] | None = None
    """robots (Fig. 1: the four robots) or transport (Fig. 2: optimal transport and the directional
    metric); by default both."""


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
