"""Train a sweep: `dgae reproduce runs/sweep --preset paper --scale 0.1`."""

import dataclasses
import shlex
import shutil
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dgae_jax.cli import parse
from dgae_jax.cli.train import Arguments as TrainArguments
from dgae_jax.cli.train import check_of_many, configure
from dgae_jax.configs.algorithms import ALGORITHMS, AlgorithmName
from dgae_jax.configs.config import Config, ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.envs.registry import TASKS
from dgae_jax.run.options import RunOptions
from dgae_jax.study import launch
from dgae_jax.study import sweep as sweeps
from dgae_jax.study.variants import VARIANTS, Variant

TRAIN = TrainArguments(settings=Config(env=""))
"""Defaults; the tasks are those of --envs."""

USED_BY = {
    "processes": ("local",),
    "address": ("ray",),
    "cpus_per_run": ("ray", "slurm"),
    "gpus_per_run": ("ray", "slurm"),
    "slurm": ("slurm",),
}
"""The launchers that use an option."""


@dataclass(frozen=True)
class Arguments:
    """Train the runs of a sweep: tasks, algorithms and seeds.

    Every flag of dgae train holds for all runs. The same command resumes a
    sweep that was stopped.
    """

    sweep: tyro.conf.Positional[Path]
    """Directory of the sweep, new or to be resumed [path]."""
    envs: tuple[str, ...] = tuple(TASKS)
    """Tasks."""
    algos: tuple[AlgorithmName, ...] = tuple(ALGORITHMS)  # pyright: ignore[reportAssignmentType]
    """Algorithms."""
    variants: Literal["attribution", "attribution-noise", "calibration", "risk"] | None = None
    """All variants of one question, instead of the algorithms."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds [1]."""
    scale: Annotated[float, parse.number(float, 1e-9, 1)] = 1.0
    """Fraction of the samples that are trained [1]."""
    seeds_per_run: Annotated[int, parse.number(int, 1, 4096)] = 1
    """Seeds that are trained in one program; more than 1 are meant for a GPU [runs]."""
    launcher: Literal["local", "ray", "slurm"] = "local"
    """local (this machine), ray (a cluster) or slurm (an array of jobs)."""
    processes: Annotated[int, parse.number(int, 1, 1024)] = launch.default_processes()
    """local: runs at a time, each with an equal share of the cores; by default one per core, or
    one in all with a GPU [processes]."""
    address: str | None = None
    """ray: HOST:PORT of the cluster's head, or auto; by default a cluster on this machine
    [address]."""
    cpus_per_run: Annotated[int, parse.number(int, 1, 1024)] = 1
    """ray, slurm: cores of each run [cores]."""
    gpus_per_run: Annotated[float, parse.number(float, 0, 64)] = 0.0
    """ray, slurm: GPUs of each run; several runs may share one with ray [GPUs]."""
    slurm: tuple[str, ...] = ()
    """slurm: more of its settings, as partition=gpu time=240 (minutes) array_parallelism=32
    [NAME=VALUE]."""
    train: Annotated[TrainArguments, tyro.conf.arg(name="")] = TRAIN


Sweep = tuple[Path, sweeps.Runs, RunOptions, launch.Launch]


def parsed(argv: list[str]) -> Sweep:
    """Return the directory, the runs, their options and their launcher."""
    args: Arguments = parse.arguments(Arguments, argv)
    _check(args)
    kinds, launcher = _kinds(args), _launcher(args)

    def make(task: str, label: str) -> ResolvedConfig:
        algo, changes = kinds[label]
        words = [*argv, "--env", task, "--algo", algo]

        def parse_over(start: TrainArguments) -> TrainArguments:
            line = parse.arguments(Arguments, words, dataclasses.replace(args, train=start)).train
            return dataclasses.replace(line, run=dataclasses.replace(line.run, inexact=False))

        settings = args.train.settings.replace(env=task, algo=algo)
        given = dataclasses.replace(args.train, settings=settings)
        config, _ = configure(given, parse_over)
        total_steps = int(args.scale * config.total_steps)
        return resolve(config.as_config().replace(total_steps=total_steps, **changes))

    runs = sweeps.grid(args.envs, list(kinds), args.seeds, args.seeds_per_run, make)
    return args.sweep, runs, args.train.run, launcher


def _check(args: Arguments) -> None:
    """Raise ConfigError for the first flag that is invalid for the sweep as a whole."""
    for name in ("envs", "algos", "seeds"):
        if not (given := getattr(args, name)) or len(set(given)) < len(given):
            raise invalid(name, given, "at least one, each once")
    if not all(0 <= seed < 2**32 for seed in args.seeds):
        raise invalid("seeds", args.seeds, f"whole numbers from 0 to {2**32 - 1:,}")
    for env in args.envs:
        if Config(env=env).env != env:
            raise invalid("envs", env, "in lower case; --env-version says which version")
    if args.train.settings.env or args.train.settings.algo:
        raise ConfigError("--env, --algo: a sweep has --envs and --algos instead")
    check_of_many(args.train)


def _kinds(args: Arguments) -> dict[str, Variant]:
    """Return what is trained on each task by its label: an algorithm, and settings."""
    given = args.train.settings
    if args.variants is None:
        return {algo: (algo, {}) for algo in args.algos}
    if args.algos != Arguments.algos:
        shown = " ".join(args.algos)
        raise ConfigError(f"algos {shown}: cannot be combined with --variants", "algos")
    kinds = VARIANTS[args.variants]
    for path in {path for _, changes in kinds.values() for path in changes}:
        if given.get(path) != TRAIN.settings.get(path):
            both = f"cannot be combined with --variants {args.variants}, which set it"
            raise ConfigError(f"{path} {given.get(path)}: {both}", path)
    return kinds


def _launcher(args: Arguments) -> launch.Launch:
    """Return the launcher that is asked for; raise ConfigError if it cannot be used."""
    name = args.launcher
    for option, launchers in USED_BY.items():
        value = getattr(args, option)
        if name not in launchers and value != getattr(Arguments, option):
            raise invalid(option, value, f"unset: it has no effect with --launcher {name}")
    if name == "local":
        return partial(launch.local, processes=args.processes)
    if name == "ray":
        launch.check_ray(args.address)
    elif args.gpus_per_run % 1:
        raise invalid("gpus_per_run", args.gpus_per_run, "a whole number with --launcher slurm")
    parse.require({"ray": "ray", "slurm": "submitit"}[name], name)
    if name == "slurm" and not shutil.which("srun"):
        raise invalid("launcher", name, "used where Slurm is: there is no srun here")
    resources = {"cpus": args.cpus_per_run, "gpus": args.gpus_per_run}
    if name == "ray":
        return partial(launch.ray_cluster, address=args.address, **resources)
    return partial(launch.slurm_array, settings=args.slurm, **resources)


@parse.command(Arguments, parsed)
def reproduce(sweep: Sweep) -> int:
    """Train the runs that are not done."""
    path, runs, options, launcher = sweep
    line = shlex.join(["dgae", "reproduce", *sys.argv[1:]])
    with sweeps.opened(path, runs, line) as opened:
        from dgae_jax.study import reproduce

        return reproduce.reproduce(opened, runs, options, launcher)
