"""Train a policy: python experiments/train.py --env hopper --algo dppo --physics native"""

import sys
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from dgae_jax import Config, ConfigError
from dgae_jax.io import cli
from dgae_jax.io.training import RunOptions, train
from dgae_jax.presets import preset


@dataclass(frozen=True)
class Arguments:
    """What to train, and where to write it."""

    preset: str = "tuned"
    """Where all other settings start: tuned (ours) or paper (its set-up)."""
    config: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = field(default_factory=RunOptions)


def main() -> int:
    """Train one run directory; 0 done, 2 bad input, 130 / 143 stopped by a signal with a checkpoint saved."""
    chosen = cli.peek(preset="tuned", algo=Config.algo, env=Config.env, policy_update="default")
    try:
        config = preset(chosen["preset"], chosen["algo"], chosen["env"], chosen["policy_update"])
        description = "Train a policy on a MuJoCo task with PPO, TRPO, A2C or their distributional variants."
        arguments = cli.parse(Arguments, description, default=Arguments(config=config))
        return train(arguments.config, arguments.run)
    except ConfigError as mistake:
        cli.fail(str(mistake))


if __name__ == "__main__":
    sys.exit(main())
