"""Train a policy: python experiments/train.py --env hopper --algo dppo --physics native"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from dgae_jax import Config, ConfigError
from dgae_jax.cli.arguments import fail, parse, peek
from dgae_jax.configs import presets
from dgae_jax.run import directory, manifest, terminal
from dgae_jax.run.checkpoint import CheckpointError
from dgae_jax.run.loop import resume, resume_or_start, train
from dgae_jax.run.options import RunOptions


@dataclass(frozen=True)
class Arguments:
    """What to train, and where to write it."""

    preset: str = "tuned"
    """Where all other settings start: tuned (ours) or paper (its set-up)."""
    config: Path | None = None
    """A config.json, of a run for example, where all other settings start instead [path]."""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = field(default_factory=RunOptions)


def main() -> int:
    """Train one run directory.

    0 done; 1 broke down or could write no more; 2 bad input; 130 / 143 stopped by SIGINT / SIGTERM with a checkpoint saved.
    """
    terminal.prepare()
    try:
        first = peek(preset="", algo=Config.algo, env=Config.env, policy_update="default", config="", resume="")
        config = _start(**first)
        description = "Train a policy on a MuJoCo task with PPO, TRPO, A2C or their distributional variants."
        run = manifest.options(Path(first["resume"])) if first["resume"] else RunOptions()
        arguments = parse(Arguments, description, default=Arguments(settings=config, run=run))
        work = resume_or_start if arguments.run.resume_or_start else resume if arguments.run.resume else train
        return work(arguments.settings, arguments.run)
    except (ConfigError, CheckpointError) as mistake:
        fail(str(mistake))
    except KeyboardInterrupt:
        print("stopped by SIGINT before training began", file=sys.stderr)
        return 130


def _start(preset: str, algo: str, env: str, policy_update: str, config: str, resume: str) -> Config:
    """Where all settings start that no flag names: a run's own, a file's, or a preset's."""
    for name, value, other in (("preset", preset, resume or config), ("config", config, resume)):
        if value and other:
            raise ConfigError(f"--{name} {value}: must be left out: all settings start from {other}")
    if resume:
        return directory.read_config(Path(resume))
    if config:
        return directory.read_config_file(Path(config))
    return presets.preset(preset or "tuned", algo, env, policy_update)


if __name__ == "__main__":
    sys.exit(main())
