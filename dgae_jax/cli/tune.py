"""Search for settings: dgae tune --env hopper --algo dppo --physics native --trials 50

Flags are checked before the rest is imported: JAX, MuJoCo, Brax and Optuna take seconds to load.
"""

import re
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from dgae_jax.cli import train
from dgae_jax.cli.arguments import fail, flags_in, parse_known, stopped
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.run import terminal

if TYPE_CHECKING:
    from dgae_jax.study.search import Tuning

PURPOSE = "Search for the settings with the highest return in Gymnasium, with Optuna."

NOTE = """Every flag of dgae train may follow, and holds for all trials. Run the same command again to go on, or several times at once to
share the work."""

EXAMPLES = (
    "dgae tune --env hopper --algo dppo --physics native",
    "dgae tune --search gamma=0.95:0.999 policy.learning_rate=log:1e-4:1e-2",
    "dgae tune --storage postgresql://USER:PASSWORD@HOST/NAME --trials 500",
)


@dataclass(frozen=True)
class Arguments:
    """What to search, how long, and with whom."""

    search: tuple[str, ...] = ("gamma=0.95:0.9999", "gae_lambda=0.5:1")
    """Settings and where to look: gamma=0.95:0.999, policy.learning_rate=log:1e-4:1e-2, num_envs=int:4:64 (or int:log:4:64),
    critic.minibatches=16,32,64, policy.hidden=64x64,256x256."""
    trials: int = 50
    """Trials to finish, by all processes together; the first one is the preset itself [trials]."""
    tuning_seeds: int = 2
    """Seeds that each trial trains and is judged by: 1000, 1001 and so on, never the 0, 1 and so on of reports [seeds]."""
    study: Path | None = None
    """Directory to write, or to go on in; by default tuning/ENV-ALGO. Its name is that of the study in the database [path]."""
    storage: str | None = None
    """Database that machines share, postgresql://USER:PASSWORD@HOST/NAME; by default optuna.db (SQLite) in the directory [URL]."""
    workers: int | None = None
    """Processes on this machine, each on cores of its own; by default one per core [processes]."""
    sampler_seed: int = 0
    """Seed of what is tried; with several workers the order in which they finish matters too [1]."""


WHOLE = {
    "trials": (1, 100_000, "Optuna reads all of them before each"),
    "tuning_seeds": (1, 100, "every one is a whole run"),
    "sampler_seed": (0, 2**31 - 1, "an int32"),
}
"""Whole numbers: from, to, and why not more."""

LEFT_OUT = {
    "left out: --tuning-seeds says how many, from 1000 on": ("--seed", "--num-seeds"),
    "left out: the trials are in --study, and go on by themselves": (
        "--run-dir",
        "--resume",
        "--resume-or-start",
        "--inexact",
    ),
    "left out: a trial is looked at after each quarter": (
        "--checkpoint-every",
        "--keep-checkpoints",
    ),
    "left out: each worker trains alone, and --storage joins them": (
        "--coordinator",
        "--num-processes",
        "--process-id",
    ),
}
"""Flags of dgae train that a tuning sets itself."""


REST = (train.Arguments,)
"""What every other flag is of."""


def main() -> int:
    """Tune; 0 done, 1 workers broke down, 2 bad input, 129 / 130 / 143 stopped by SIGHUP / SIGINT / SIGTERM."""
    terminal.prepare()
    try:
        tuning = _tuning(sys.argv[1:])
        from dgae_jax.study.tune import tune

        return tune(tuning)
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT; the same command goes on")


def _tuning(argv: list[str]) -> "Tuning":
    """What a command line means; raises ConfigError for the first argument that is invalid."""
    arguments, rest = parse_known(Arguments, PURPOSE, argv, EXAMPLES, NOTE, REST)
    given = flags_in(rest)
    for why, names in LEFT_OUT.items():
        for name in given.intersection(names):
            raise ConfigError(f"{name}: must be {why}")
    config, options = train.parsed(rest)
    _check(arguments)
    storage = _storage(arguments.storage)
    from dgae_jax.study.search import Tuning, space_of

    return Tuning(
        config,
        space_of(arguments.search, config),
        arguments.study or Path("tuning") / f"{config.task}-{config.algo}".replace(":", "-"),
        options,
        storage,
        arguments.trials,
        arguments.tuning_seeds,
        _workers(arguments),
        arguments.sampler_seed,
    )


def _check(arguments: Arguments) -> None:
    for name, (low, high, reason) in WHOLE.items():
        if not low <= (value := getattr(arguments, name)) <= high:
            raise invalid(name, value, f"a whole number from {low:,} to {high:,} ({reason})")
    if not arguments.search:
        raise ConfigError("--search: must name a setting, gamma=0.95:0.999 for one")
    if arguments.study is not None and not re.fullmatch(
        r"[^/\0]{1,200}", arguments.study.absolute().name
    ):
        raise invalid("study", arguments.study, "a directory with a name of its own")


def _storage(url: str | None) -> str | None:
    """The address as SQLAlchemy takes it, with the driver that we install."""
    missing = next(
        (name for name in ("optuna", *(["psycopg"] if url else [])) if find_spec(name) is None),
        None,
    )
    if missing:
        raise ConfigError(f'{missing}: must be installed for tuning: pip install "dgae_jax[tune]"')
    if url is None:
        return None
    scheme, colon, rest = url.partition("://")
    if not (colon and rest and scheme in ("postgresql", "postgres", "postgresql+psycopg")):
        raise invalid(
            "storage",
            f"{scheme}://…" if colon else url,
            "postgresql://USER:PASSWORD@HOST/NAME, or left out for SQLite",
        )
    return f"postgresql+psycopg://{rest}"


def _workers(arguments: Arguments) -> int:
    """Processes on this machine."""
    from dgae_jax.physics.registry import cores

    wanted, there = arguments.workers, cores()
    if wanted is None:
        return min(there, arguments.trials)
    if not 1 <= wanted <= there:
        raise invalid(
            "workers", wanted, f"a whole number from 1 to {there}, the cores of this machine"
        )
    return wanted


if __name__ == "__main__":
    sys.exit(main())
