"""Make a film of a trained run: dgae render RUN_DIR --episodes 2

Flags are checked, and the OpenGL to draw with is chosen, before the rest is imported: JAX and MuJoCo take seconds to load.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dgae_jax.cli.arguments import fail, parse, stopped
from dgae_jax.cli.source import check_file, check_index
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import TASKS, spec_of
from dgae_jax.export import encoding, gl
from dgae_jax.run import directory, files, terminal
from dgae_jax.run.options import RunOptions

PURPOSE = "Make a film of the deterministic policy of a trained run, in Gymnasium."

EXAMPLES = (
    "dgae render runs/walker",
    "dgae render runs/walker --compare runs/hopper --seconds 5 --format gif",
    "dgae render runs/walker --during --out walker.mp4 --format mp4",
)


@dataclass(frozen=True)
class Arguments:
    """What to film, and how."""

    run_dir: tyro.conf.Positional[Path]
    """Directory of the run, or the file of dgae refit [path]."""
    compare: tuple[Path, ...] = ()
    """Further runs from the same initial states, shown beside it, from four on in a square [paths]."""
    checkpoint: Literal["latest", "best"] | None = None
    """latest, or best: of the evaluations while it trained; by default latest."""
    during: bool = False
    """The policy at each checkpoint that the run keeps, one after the other, so that one sees it learn."""
    index: int = 0
    """Which of the seeds that were trained side by side, from 0."""
    episodes: int = 1
    """Episodes, one after the other [episodes]."""
    seed: int = 0
    """Seed of the initial states, the same as those of an evaluation [1]."""
    seconds: float = 10.0
    """Longest part of an episode that is shown, in the robot's own time [s]."""
    format: Literal["mp4", "gif", "both"] = "both"
    """Files to write."""
    width: int = 480
    """Width of the picture of each robot, even [pixels]."""
    height: int = 360
    """Height of the picture of each robot without the strip below it, even [pixels]."""
    fps: int = 25
    """Frames per second of the MP4; a GIF has at most half of the default [1/s]."""
    out: Path | None = None
    """File to write, to whose name .mp4 and .gif are added; by default video in the run directory, video-best,
    video-during or video-compare [path]."""
    cache_dir: str = RunOptions.cache_dir
    """Where compiled programs are kept between runs; none disables [path]."""


WHOLE = {
    "episodes": (1, 1_000, 1),
    "seed": (0, 2**31 - 1, 1),
    "width": (160, 1920, 2),
    "height": (120, 1080, 2),
    "fps": (1, 100, 1),
}
"""Whole numbers: from, to, and what they are a multiple of."""

LONGEST = 600.0
"""Seconds of an episode."""


def main() -> int:
    """Film one run or several; 0 done, 2 bad input or no OpenGL, 130 stopped by SIGINT."""
    terminal.prepare()
    try:
        arguments = parse(Arguments, PURPOSE, examples=EXAMPLES)
        _check(arguments)
        sources = (arguments.run_dir, *arguments.compare)
        if any(path.is_file() for path in sources):
            gl.choose()  # to read the configuration in a policy's file imports MuJoCo
        configs = [_config(path, arguments.index) for path in sources]
        _check_out(arguments)
        gl.choose()
        return _render(arguments, configs)
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT, nothing written")


def _check(arguments: Arguments) -> None:
    """Raise ConfigError for the first argument that is invalid."""
    for name, (low, high, multiple) in WHOLE.items():
        value = getattr(arguments, name)
        if not low <= value <= high or value % multiple:
            kind = "an even" if multiple == 2 else "a whole"
            raise invalid(name, value, f"{kind} number from {low:,} to {high:,}")
    if not 0 < arguments.seconds <= LONGEST:
        raise invalid("seconds", arguments.seconds, f"a number above 0, up to {LONGEST:g}")
    for other in ("compare", "checkpoint"):
        if arguments.during and getattr(arguments, other):
            raise invalid(
                other,
                getattr(arguments, other),
                "left out with --during, which shows every checkpoint of one run",
            )
    if arguments.during and arguments.run_dir.is_file():
        raise ConfigError(f"--during: must be left out with {arguments.run_dir}, a single policy")
    encoding.check_installed()


def _check_out(arguments: Arguments) -> None:
    stem = _stem(arguments)
    for kind in encoding.FORMATS[arguments.format]:
        check_file(stem.with_name(f"{stem.name}.{kind}"))


def _config(path: Path, index: int) -> ResolvedConfig:
    """The configuration of a run that Gymnasium can play."""
    config = directory.config_of(path)
    if not spec_of(config.env).eval_envs:
        raise ConfigError(
            f"{path}: must be a run of {', '.join(TASKS)}, which can be filmed; it is one of {config.env}"
        )
    check_index(index, config, path)
    return config


def _stem(arguments: Arguments) -> Path:
    """The file to write, without its ending."""
    if arguments.out is None:
        kinds = {
            "during": arguments.during,
            "compare": arguments.compare,
            "best": arguments.checkpoint == "best",
        }
        return files.beside(
            arguments.run_dir,
            "-".join(["video", *(kind for kind, is_so in kinds.items() if is_so)]),
        )
    out = arguments.out
    return out.with_suffix("") if out.suffix in (".mp4", ".gif") else out


def _titles(paths: list[Path]) -> list[str]:
    """The names of the runs; their whole paths where two names are the same."""
    names = [path.resolve().name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def _render(arguments: Arguments, configs: list[ResolvedConfig]) -> int:
    from dgae_jax.export import video
    from dgae_jax.run import runtime
    from dgae_jax.run.terminal import Reporter

    runtime.use_devices(configs[0], RunOptions(devices=1, num_processes=1))
    runtime.use_cache(arguments.cache_dir)
    clip = video.Clip(arguments.episodes, arguments.seed, arguments.seconds)
    paths = [arguments.run_dir, *arguments.compare]
    if arguments.during:
        scenes = video.of_checkpoints(arguments.run_dir, configs[0], arguments.index, clip)
    else:
        runs = list(zip(_titles(paths), paths, configs, strict=True))
        scenes = video.of_runs(runs, arguments.checkpoint or "latest", arguments.index, clip)
    stem, size = _stem(arguments), (arguments.width, arguments.height)
    with Reporter() as reporter:
        frames = video.frames(scenes, *size, arguments.fps, reporter.watch)
        try:
            written = encoding.write(
                frames, stem, encoding.FORMATS[arguments.format], arguments.fps
            )
        except OSError as reason:
            raise invalid(
                "out", stem, f"a file that can be written ({reason.strerror})"
            ) from reason
    for path in written:
        terminal.say(f"written to {path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
