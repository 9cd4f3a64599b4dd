"""Search for hyperparameters: `dgae tune --env hopper --algo dppo --trials 50`."""

import dataclasses
import re
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dgae_jax.cli import parse
from dgae_jax.cli.train import Arguments as TrainArguments
from dgae_jax.cli.train import configure
from dgae_jax.configs.config import ConfigError, invalid

if TYPE_CHECKING:
    from dgae_jax.study.search import Tuning


@dataclass(frozen=True)
class Arguments:
    """Search for the settings with the highest return in Gymnasium, with Optuna.

    Every flag of dgae train holds for all trials. Run the same command again to
    resume, or several times at once to share the work.

    Examples:
      dgae tune --env hopper --algo dppo --physics native
      dgae tune --search gamma=0.95:0.999 policy.learning_rate=log:1e-4:1e-2
      dgae tune --storage postgresql://USER:PASSWORD@HOST/NAME --trials 500
    """

    search: tuple[str, ...] = ("gamma=0.95:0.9999", "gae_lambda=0.5:1")
    """Settings and their values: gamma=0.95:0.999, policy.learning_rate=log:1e-4:1e-2,
    num_envs=int:4:64 (or int:log:4:64), critic.minibatches=16,32,64, policy.hidden=64x64,32."""
    trials: int = 50
    """Trials to finish, by all processes together; the first one is the preset itself [trials]."""
    tuning_seeds: int = 2
    """Seeds of each trial: 1000, 1001 and so on, never the 0, 1 and so on of reports [seeds]."""
    study: Path | None = None
    """Directory to write or to resume; by default tuning/ENV-ALGO. Its name is that of the study
    in the database [path]."""
    storage: str | None = None
    """Database that machines share, postgresql://USER:PASSWORD@HOST/NAME; by default optuna.db
    (SQLite) in the directory [URL]."""
    workers: int | None = None
    """Processes on this machine, each on its own cores; by default one per core [processes]."""
    sampler_seed: int = 0
    """Seed of the sampler; with several workers the order in which they finish matters too [1]."""
    train: Annotated[TrainArguments, tyro.conf.arg(name="")] = field(default_factory=TrainArguments)


LEFT_OUT = {
    "--tuning-seeds says how many, from 1000 on": ("--seed", "--num-seeds"),
    "the trials are in --study": ("--run-dir", "--resume", "--resume-or-start", "--inexact"),
    "a trial is evaluated after each quarter": ("--checkpoint-every", "--keep-checkpoints"),
    "each worker trains alone": ("--coordinator", "--num-processes", "--process-id"),
}
"""Flags of dgae train that a tuning sets itself, by the reason."""


def parsed(argv: list[str]) -> "Tuning":
    """Return the tuning of a command line; raise ConfigError for the first mistake."""
    args = parse.peek(Arguments, argv) or parse.arguments(Arguments, argv)
    for reason, names in LEFT_OUT.items():
        for name in parse.flags_in(argv).intersection(names):
            raise ConfigError(f"{name}: must be left out: {reason}")

    def parse_over(start: TrainArguments) -> TrainArguments:
        return parse.arguments(Arguments, argv, dataclasses.replace(args, train=start)).train

    config, options = configure(args.train, parse_over)
    parse.check(args, trials=(1, 100_000), tuning_seeds=(1, 100), sampler_seed=parse.INT32)
    if not args.search:
        raise ConfigError("--search: must name a setting, gamma=0.95:0.999 for one")
    study = args.study or Path("tuning") / f"{config.task}-{config.algo}".replace(":", "-")
    if not re.fullmatch(r"[^/\0]{1,200}", study.absolute().name):
        raise invalid("study", study, "a directory with a name")
    storage = _storage(args.storage)
    from dgae_jax.study.search import Tuning, space_of

    return Tuning(
        config,
        space_of(args.search, config),
        study,
        options,
        storage,
        trials=args.trials,
        seeds=args.tuning_seeds,
        workers=_workers(args),
        sampler_seed=args.sampler_seed,
    )


def _storage(url: str | None) -> str | None:
    """Return the address as SQLAlchemy takes it, with the driver that we install."""
    for name in ("optuna", "psycopg") if url else ("optuna",):
        if find_spec(name) is None:
            raise ConfigError(f'{name}: must be installed: pip install "dgae_jax[tune]"')
    if url is None:
        return None
    scheme, colon, rest = url.partition("://")
    if not (colon and rest and scheme in ("postgresql", "postgres", "postgresql+psycopg")):
        shown = f"{scheme}://…" if colon else url  # what follows may be a password
        raise invalid("storage", shown, "postgresql://USER:PASSWORD@HOST/NAME, or left out")
    return f"postgresql+psycopg://{rest}"


def _workers(args: Arguments) -> int:
    from dgae_jax.physics import cores

    if args.workers is None:
        return min(cores(), args.trials)
    parse.check(args, workers=(1, cores(), "the cores of this machine"))
    return args.workers


@parse.command(Arguments, parsed)
def tune(tuning: "Tuning") -> int:
    """Finish the trials of a tuning."""
    from dgae_jax.study import tune

    return tune.tune(tuning)
