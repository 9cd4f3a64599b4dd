"""Search for hyperparameters: `dgae tune --env hopper --algo dppo --trials 50`."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dgae_jax.cli import parse
from dgae_jax.cli.train import DEFAULTS, check_of_many, configure
from dgae_jax.cli.train import Arguments as TrainArguments
from dgae_jax.configs.config import ConfigError
from dgae_jax.physics import cores

if TYPE_CHECKING:
    from dgae_jax.study.search import Tuning


@dataclass(frozen=True)
class Arguments:
    """Search for the settings with the highest return in Gymnasium, with Optuna.

    Every flag of dgae train holds for all trials. Run the same command again to
    resume, or several times at once to share the work.
    """

    search: tuple[str, ...] = ("gamma=0.95:0.9999", "gae_lambda=0.5:1")
    """Settings and their values: gamma=0.95:0.999, policy.learning_rate=log:1e-4:1e-2,
    num_envs=int:4:64 (or int:log:4:64), critic.minibatches=16,32,64, policy.hidden=64x64,32."""
    trials: Annotated[int, parse.number(int, 1, 100_000)] = 50
    """Trials to finish, by all processes together; the first one is the preset itself [trials]."""
    tuning_seeds: Annotated[int, parse.number(int, 1, 100)] = 2
    """Seeds of each trial: 1000, 1001 and so on, never the 0, 1 and so on of reports [seeds]."""
    study: Path | None = None
    """Directory to write or to resume; by default tuning/ENV-ALGO [path]."""
    storage: str | None = None
    """Database that machines share; by default optuna.db (SQLite) in the directory [URL]."""
    workers: Annotated[int, parse.number(int, 1, cores())] = cores()
    """Processes on this machine, each on its own cores [processes]."""
    sampler_seed: Annotated[int, parse.number(int, 0, 2**31 - 1)] = 0
    """Seed of the sampler; with several workers the order in which they finish matters too [1]."""
    train: Annotated[TrainArguments, tyro.conf.arg(name="")] = DEFAULTS


def parsed(argv: list[str]) -> "Tuning":
    """Return the tuning of a command line; raise ConfigError for the first mistake."""
    args = parse.peek(Arguments, argv) or parse.arguments(Arguments, argv)
    check_of_many(args.train, "checkpoint_every", "keep_checkpoints", "inexact")
    parse.require("optuna", "tune")
    if args.storage and not args.storage.startswith("postgresql://"):
        # the address may have a password
        raise ConfigError("--storage: must be postgresql://USER:PASSWORD@HOST/NAME, or left out")

    def parse_over(start: TrainArguments) -> TrainArguments:
        return parse.arguments(Arguments, argv, dataclasses.replace(args, train=start)).train

    config, options = configure(args.train, parse_over)
    from dgae_jax.study.search import Tuning, space_of

    return Tuning(
        config,
        space_of(args.search, config),
        args.study or Path("tuning") / f"{config.task}-{config.algo}".replace(":", "-"),
        dataclasses.replace(options, num_processes=1),
        args.storage,
        trials=args.trials,
        seeds=args.tuning_seeds,
        workers=min(args.workers, args.trials),
        sampler_seed=args.sampler_seed,
    )


@parse.command(Arguments, parsed)
def tune(tuning: "Tuning") -> int:
    """Finish the trials of a tuning."""
    from dgae_jax.study import tune

    return tune.tune(tuning)
