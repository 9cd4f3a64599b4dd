"""Train a policy: dgae train --env hopper --algo dppo --physics native

Flags are checked before the rest is imported: JAX, MuJoCo and Brax take seconds to load.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from dgae_jax.cli.arguments import fail, parse, peek, stopped
from dgae_jax.cli.spelling import understood
from dgae_jax.configs.config import Config, ConfigError, invalid
from dgae_jax.configs.presets import preset
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.run import directory, terminal
from dgae_jax.run.options import RunOptions, validate_options

PURPOSE = "Train a policy with PPO, TRPO, A2C or a distributional variant of them."

NOTE = """The defaults are those of the preset for the task and the algorithm: dgae train --algo trpo --help shows TRPO's. A number may be
written 1e6 or 1_000_000, and a task Hopper-v4."""

EXAMPLES = (
    "dgae train --env hopper --algo dppo --physics native --total-steps 2e5",
    "dgae train --env Walker2d-v5 --algo ppo --run-dir runs/walker",
    "dgae train --resume runs/walker",
)


@dataclass(frozen=True)
class Arguments:
    """What to train, and where to write it."""

    preset: str = "tuned"
    """Where all other settings start: tuned (ours) or paper (its set-up)."""
    config: Path | None = None
    """A config.json, of a run for example, where all other settings start instead [path]."""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(
        default_factory=lambda: resolve(Config()).as_config()
    )
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = field(default_factory=RunOptions)


def main() -> int:
    """Train one run directory.

    0 done; 1 broke down or could write no more; 2 bad input; 129 / 130 / 143 stopped by SIGHUP / SIGINT / SIGTERM.
    """
    terminal.prepare()
    try:
        config, options = parsed(sys.argv[1:])
        from dgae_jax.run import training

        return training.train_command(config, options)
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT before training began")


def parsed(argv: list[str]) -> tuple[ResolvedConfig, RunOptions]:
    """The configuration in full and the options that a command line means; raises ConfigError for the first that is invalid."""
    argv = understood(argv)
    given = peek(argv, "preset", "config", "resume", "algo", "env", "policy.update", "critic.kind")
    for name in (name for name, value in given.items() if value == ""):
        raise ConfigError(f"{name}: must be followed by a value", name)
    config = _start(given)
    options = directory.saved_options(Path(given["resume"])) if given["resume"] else RunOptions()
    arguments = parse(
        Arguments, PURPOSE, argv, Arguments(settings=config, run=options), EXAMPLES, NOTE
    )
    config = resolve(arguments.settings)
    validate_options(arguments.run, config)
    return config, arguments.run


def _start(given: dict[str, str | None]) -> Config:
    """Where all settings start that no flag names: a run's own, a file's, or a preset's."""
    name, file, resume, algo = given["preset"], given["config"], given["resume"], given["algo"]
    for setting, value, other in (("preset", name, resume or file), ("config", file, resume)):
        if value and other:
            raise invalid(setting, value, f"left out: all settings start from {other}")
    if not (resume or file):
        update, critic = given["policy.update"], given["critic.kind"]
        return resolve(
            preset(name or "tuned", algo or "dppo", given["env"] or Config.env, update, critic)
        ).as_config()
    config = (
        directory.read_config(Path(resume))
        if resume
        else directory.read_config_file(Path(str(file)))
    )
    if algo not in (None, config.algo):
        raise invalid("algo", algo, f"{config.algo} as in {resume or file}, or left out")
    return config.as_config()


if __name__ == "__main__":
    sys.exit(main())
