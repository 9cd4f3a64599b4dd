"""Train a policy: `dgae train --env hopper --algo dppo --physics native`."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dgae_jax.cli import parse
from dgae_jax.configs.config import Config, ConfigError, flag, invalid
from dgae_jax.configs.presets import preset
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.run import directory
from dgae_jax.run.options import RunOptions, validate_options


@dataclass(frozen=True)
class Arguments:
    """Train a policy with PPO, TRPO, A2C or a distributional variant of them.

    The defaults are those of the preset for the task and the algorithm: with
    --algo trpo, --help shows those of TRPO. Numbers may be 1e6, tasks Hopper-v4.

    Examples:
      dgae train --env hopper --algo dppo --physics native --run-dir runs/first
      dgae train --resume runs/first --total-steps 2e6
    """

    preset: Literal["tuned", "paper"] | None = None
    """Where all other settings start: tuned (ours, the default) or paper (its set-up)."""
    config: Path | None = None
    """A config.json, of a run for example, where all other settings start instead [path]."""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    shared: Annotated[parse.Shared, tyro.conf.arg(name="")] = field(default_factory=parse.Shared)
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = field(default_factory=RunOptions)


DEFAULTS = Arguments()

OF_ONE_RUN = (
    *("seed", "num_seeds", "run_dir", "resume", "resume_or_start"),
    *("coordinator", "num_processes", "process_id"),
)


def check_of_many(given: Arguments, *more: str) -> None:
    """Raise ConfigError for a flag of a single run, or another that cannot be given."""
    for name in (*OF_ONE_RUN, *more):
        part = "run" if hasattr(given.run, name) else "settings"
        if getattr(getattr(given, part), name) != getattr(getattr(DEFAULTS, part), name):
            raise ConfigError(f"{flag(name)}: cannot be combined with many runs")


def parsed(argv: list[str]) -> tuple[ResolvedConfig, RunOptions]:
    """Return the configuration and the options of a command line."""
    given = parse.peek(Arguments, argv) or DEFAULTS
    return configure(given, lambda start: parse.arguments(Arguments, argv, start))


def configure(
    given: Arguments, parse_over: Callable[[Arguments], Arguments]
) -> tuple[ResolvedConfig, RunOptions]:
    """Parse a command line over the settings where it starts, which `given` names, and check it."""
    resume, file = given.run.resume, given.run.resume or given.config
    options = directory.saved_options(resume) if resume else RunOptions()
    start = given.shared.apply(_start(given))
    found = parse_over(Arguments(settings=start, run=options))
    if file and found.settings.algo != start.algo:
        raise invalid("algo", found.settings.algo, f"{start.algo} as in {file}, or left out")
    config = resolve(found.settings)
    validate_options(found.run, config)
    return config, found.run


def _start(given: Arguments) -> Config:
    """Return the settings that hold where no flag is given: a run's, a file's, or a preset's."""
    resume, file, ours = given.run.resume, given.config, given.settings
    for name, value, other in (("preset", given.preset, resume or file), ("config", file, resume)):
        if value and other:
            raise ConfigError(f"{name} {value}: cannot be combined with {other}", name)
    if resume:
        return directory.read_config(resume).as_config()
    if file:
        return directory.read_config_file(file).as_config()
    algo, kind = ours.algo or "dppo", ours.critic.kind
    config = preset(given.preset or "tuned", algo, ours.env, ours.policy.update, kind)
    return resolve(config.replace(env_version=ours.env_version)).as_config()


@parse.command(Arguments, parsed)
def train(run: tuple[ResolvedConfig, RunOptions]) -> int:
    """Train, or resume a training."""
    from dgae_jax.run import training

    return training.train_command(*run)
