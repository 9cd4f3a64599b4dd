"""Train all of a study: dgae reproduce runs/paper --preset paper --scale 0.1

Flags are checked before the rest is imported: JAX, MuJoCo and Brax take seconds to load.
"""

import dataclasses
import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from dgae_jax.cli import train
from dgae_jax.cli.arguments import fail, flags_in, parse_known, stopped
from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import Config, ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.validation import lookup, task_spec
from dgae_jax.envs.registry import TASKS
from dgae_jax.run import terminal
from dgae_jax.run.options import RunOptions, saved_options
from dgae_jax.study import sweep as sweeps
from dgae_jax.study.launch import LaunchOptions, launcher
from dgae_jax.study.variants import Variant, variants

PURPOSE = "Train the cells of a study: tasks, algorithms and seeds."

NOTE = "Every flag of dgae train may follow, and holds for all cells. The same command goes on where a study was stopped."

EXAMPLES = (
    "dgae reproduce studies/tuned --envs hopper walker2d --algos ppo dppo",
    "dgae reproduce studies/paper --preset paper --scale 0.1 --physics native",
    "dgae reproduce studies/why --variants attribution --envs hopper --scale 0.5",
)


@dataclass(frozen=True)
class Arguments:
    """Which cells, and who trains them."""

    study: tyro.conf.Positional[Path]
    """Directory of the study, new or one to go on with [path]."""
    preset: str = "tuned"
    """Where the settings of every cell start: tuned (ours) or paper (its set-up)."""
    config: Path | None = None
    """A configuration, of a tuning for example, where they start instead; with one --algos [path]."""
    envs: tuple[str, ...] = tuple(TASKS)
    """Tasks."""
    algos: tuple[str, ...] = tuple(ALGORITHMS)
    """Algorithms."""
    variants: str | None = None
    """Instead of the algorithms, all variants of one question: attribution, attribution-noise,
    calibration or risk."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds [1]."""
    scale: float = 1.0
    """Fraction of the preset's samples [1]."""
    seeds_per_run: int = 1
    """Seeds that are trained side by side in one program: 1 is the fastest on a CPU, more are meant for a GPU [runs]."""
    inexact: bool = False
    """Let cells go on that were begun with another device, number of cores or versions: the same in the statistical sense only."""
    launch: Annotated[LaunchOptions, tyro.conf.arg(name="")] = field(default_factory=LaunchOptions)


REST = (train.Arguments,)
"""What every other flag is of."""


def main() -> int:
    """Train what is not done; 0 all done, 1 some failed, 2 bad input, 130 / 143 / 129 stopped by a signal."""
    terminal.prepare()
    try:
        arguments, rest = parse_known(Arguments, PURPOSE, sys.argv[1:], EXAMPLES, NOTE, REST)
        cells, options = _cells(arguments, rest)
        launch = launcher(arguments.launch)
        with sweeps.opened(
            arguments.study, cells, shlex.join(["dgae", "reproduce", *sys.argv[1:]])
        ) as study:
            from dgae_jax.study.reproduce import reproduce

            return reproduce(study, cells, options, launch)
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT before training began")


def _cells(arguments: Arguments, rest: list[str]) -> tuple[list[sweeps.RunSpec], RunOptions]:
    """What the command line means; raises ConfigError for the first thing that is invalid."""
    for name in ("envs", "algos", "seeds"):
        given = getattr(arguments, name)
        if not given or len(set(given)) < len(given):
            raise invalid(name, given, "at least one, each once")
    for task in arguments.envs:
        task_spec(Config(env=task), "envs")
    for algo in arguments.algos:
        lookup("algos", algo, ALGORITHMS)
    if not all(0 <= seed < 2**32 for seed in arguments.seeds):
        raise invalid("seeds", arguments.seeds, f"whole numbers from 0 to {2**32 - 1:,}")
    if not 0 < arguments.scale <= 1:
        raise invalid("scale", arguments.scale, "above 0 and at most 1")
    if not 1 <= arguments.seeds_per_run <= len(arguments.seeds):
        raise invalid(
            "seeds_per_run",
            arguments.seeds_per_run,
            f"a whole number from 1 to the number of seeds, {len(arguments.seeds)}",
        )
    if arguments.scale != 1 and "--total-steps" in flags_in(rest):
        raise invalid("scale", arguments.scale, "left out with --total-steps")
    if arguments.config and arguments.variants is None and len(arguments.algos) > 1:
        raise invalid("config", arguments.config, "used with one of --algos")
    kinds = _kinds(arguments, rest)
    options = RunOptions()

    def make(task: str, kind: str) -> ResolvedConfig:
        nonlocal options
        start = (
            ["--config", str(arguments.config)]
            if arguments.config
            else ["--preset", arguments.preset]
        )
        algo, changes = kinds[kind]
        config, options = train.parsed([*start, "--env", task, "--algo", algo, *rest])
        config = resolve(config.as_config().replace(**changes))
        _refuse(config, options, task, algo)
        return config if arguments.scale == 1 else _scaled(config, arguments.scale)

    cells = sweeps.grid(
        arguments.envs, list(kinds), arguments.seeds, arguments.seeds_per_run, make
    )
    return cells, dataclasses.replace(options, inexact=arguments.inexact)


def _scaled(config: ResolvedConfig, scale: float) -> ResolvedConfig:
    steps = int(scale * config.total_steps)
    if steps < config.samples_per_iteration:
        share = f"{config.samples_per_iteration:,} of {config.total_steps:,} samples"
        raise invalid(
            "scale",
            scale,
            f"large enough for one iteration of {config.algo} on {config.env}, {share}",
        )
    return dataclasses.replace(config, total_steps=steps)


def _kinds(arguments: Arguments, rest: list[str]) -> dict[str, Variant]:
    """What is trained on each task by its name: an algorithm, and settings."""
    if arguments.variants is None:
        return {algo: (algo, {}) for algo in arguments.algos}
    if arguments.config:
        raise invalid(
            "config",
            arguments.config,
            "left out with --variants, each of which has an algorithm of its own",
        )
    if arguments.algos != Arguments.algos:
        raise invalid("algos", arguments.algos, "left out with --variants")
    kinds = variants(arguments.variants)
    set_by_them = {f"--{path.replace('_', '-')}" for _, changes in kinds.values() for path in changes}
    for name in sorted(flags_in(rest) & set_by_them):
        raise ConfigError(
            f"{name}: must be left out with --variants {arguments.variants}, whose variants set it"
        )
    return kinds


def _refuse(config: ResolvedConfig, options: RunOptions, task: str, algo: str) -> None:
    """What belongs to one run alone."""
    for name, ours in (("env", task), ("algo", algo)):
        if getattr(config, name) != ours:
            raise invalid(name, getattr(config, name), f"left out: --{name}s says which")
    if config.seed or config.num_seeds != 1:
        name = "seed" if config.seed else "num_seeds"
        raise invalid(
            name, getattr(config, name), "left out: --seeds and --seeds-per-run say which"
        )
    for name, usual in dataclasses.asdict(RunOptions(devices=options.devices)).items():
        value = getattr(options, name)
        if value != usual and name != "cache_dir" and name not in saved_options(options):
            raise invalid(name, value, "left out: it is of one run alone")


if __name__ == "__main__":
    sys.exit(main())
