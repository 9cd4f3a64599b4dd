"""Train a sweep: `dgae reproduce studies/paper --preset paper --scale 0.1`."""

import dataclasses
import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dgae_jax.cli import parse
from dgae_jax.cli.train import Arguments as TrainArguments
from dgae_jax.cli.train import configure
from dgae_jax.configs.algorithms import ALGORITHMS, AlgorithmName
from dgae_jax.configs.config import Config, ConfigError, flag, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.validation import task_spec
from dgae_jax.envs.registry import TASKS
from dgae_jax.run.options import RunOptions, saved_options
from dgae_jax.study import sweep as sweeps
from dgae_jax.study.launch import LaunchOptions, launcher
from dgae_jax.study.variants import Variant, variants


@dataclass(frozen=True)
class Arguments:
    """Train the runs of a sweep: tasks, algorithms and seeds.

    Every flag of dgae train holds for all runs. The same command resumes a
    sweep that was stopped.

    Examples:
      dgae reproduce studies/tuned --envs hopper walker2d --algos ppo dppo
      dgae reproduce studies/paper --preset paper --scale 0.1 --physics native
      dgae reproduce studies/why --variants attribution --envs hopper --scale 0.5
    """

    study: tyro.conf.Positional[Path]
    """Directory of the sweep, new or to be resumed [path]."""
    envs: tuple[str, ...] = tuple(TASKS)
    """Tasks."""
    algos: tuple[AlgorithmName, ...] = tuple(ALGORITHMS)  # pyright: ignore[reportAssignmentType]
    """Algorithms."""
    variants: Literal["attribution", "attribution-noise", "calibration", "risk"] | None = None
    """All variants of one question, instead of the algorithms."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds [1]."""
    scale: float = 1.0
    """Fraction of the preset's samples [1]."""
    seeds_per_run: int = 1
    """Seeds that are trained in one program; more than 1 are meant for a GPU [runs]."""
    launch: Annotated[LaunchOptions, tyro.conf.arg(name="")] = field(default_factory=LaunchOptions)
    train: Annotated[TrainArguments, tyro.conf.arg(name="")] = field(default_factory=TrainArguments)


Sweep = tuple[Arguments, list[sweeps.RunSpec], RunOptions]


def parsed(argv: list[str]) -> Sweep:
    """Return the flags, the runs and their options; raise ConfigError for the first mistake."""
    args: Arguments = parse.arguments(Arguments, argv)
    flags = parse.flags_in(argv)
    _check(args, flags)
    kinds = _kinds(args, flags)
    options = RunOptions()

    def make(task: str, label: str) -> ResolvedConfig:
        nonlocal options
        algo, changes = kinds[label]
        words = [*argv, "--env", task, "--algo", algo]

        def parse_over(start: TrainArguments) -> TrainArguments:
            line = parse.arguments(Arguments, words, dataclasses.replace(args, train=start)).train
            return dataclasses.replace(line, run=dataclasses.replace(line.run, inexact=False))

        settings = args.train.settings.replace(env=task, algo=algo)
        config, options = configure(dataclasses.replace(args.train, settings=settings), parse_over)
        return _scale(resolve(config.as_config().replace(**changes)), args.scale)

    runs = sweeps.grid(args.envs, list(kinds), args.seeds, args.seeds_per_run, make)
    return args, runs, dataclasses.replace(options, inexact=args.train.run.inexact)


def _check(args: Arguments, flags: set[str]) -> None:
    """Raise ConfigError for the first flag that is invalid for the sweep as a whole."""
    for name in ("envs", "algos", "seeds"):
        if not (given := getattr(args, name)) or len(set(given)) < len(given):
            raise invalid(name, given, "at least one, each once")
    for env in args.envs:
        task_spec(Config(env=env), "envs")
        if Config(env=env).env != env:
            raise invalid("envs", env, "in lower case; --env-version says which version")
    if not all(0 <= seed < 2**32 for seed in args.seeds):
        raise invalid("seeds", args.seeds, f"whole numbers from 0 to {2**32 - 1:,}")
    if not 0 < args.scale <= 1:
        raise invalid("scale", args.scale, "above 0 and at most 1")
    parse.check(args, seeds_per_run=(1, len(args.seeds), "the number of seeds"))
    if args.scale != 1 and "--total-steps" in flags:
        raise invalid("scale", args.scale, "left out with --total-steps")
    of_all = {*saved_options(RunOptions()), "cache_dir", "inexact"}
    of_one = [f.name for f in dataclasses.fields(RunOptions) if f.name not in of_all]
    for name in ("env", "algo", "seed", "num_seeds", *of_one):
        if flag(name) in flags:
            raise ConfigError(f"{flag(name)}: must be left out: the sweep has many runs")


def _kinds(args: Arguments, flags: set[str]) -> dict[str, Variant]:
    """Return what is trained on each task by its label: an algorithm, and settings."""
    file = args.train.config
    if args.variants is None:
        if file and len(args.algos) > 1:
            raise invalid("config", file, "used with one of --algos")
        return {algo: (algo, {}) for algo in args.algos}
    if file:
        raise invalid("config", file, "left out with --variants: each has its algorithm")
    if args.algos != Arguments.algos:
        raise invalid("algos", args.algos, "left out with --variants")
    kinds = variants(args.variants)
    for name in sorted({flag(path) for _, changes in kinds.values() for path in changes} & flags):
        raise ConfigError(f"{name}: must be left out with --variants {args.variants}, which set it")
    return kinds


def _scale(config: ResolvedConfig, scale: float) -> ResolvedConfig:
    steps = int(scale * config.total_steps)
    if steps < config.samples_per_iteration:
        share = f"{config.samples_per_iteration:,} of {config.total_steps:,} samples"
        allowed = f"enough for one iteration of {config.algo} on {config.env}, {share}"
        raise invalid("scale", scale, allowed)
    return dataclasses.replace(config, total_steps=steps)


@parse.command(Arguments, parsed)
def reproduce(sweep: Sweep) -> int:
    """Train the runs that are not done."""
    args, runs, options = sweep
    launch = launcher(args.launch)
    line = shlex.join(["dgae", "reproduce", *sys.argv[1:]])
    with sweeps.opened(args.study, runs, line) as opened:
        from dgae_jax.study import reproduce

        return reproduce.reproduce(opened, runs, options, launch)
