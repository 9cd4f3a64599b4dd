"""A tuning: what is searched, from where, how long, and where it is kept. Nothing here imports JAX or Optuna."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.run.options import RunOptions
from dgae_jax.study.search import Space, values_of, with_values

FIRST_SEED = 1000
"""Of the seeds that trials are trained with; reports use 0, 1, …, which no choice of settings has seen."""

QUARTERS = 4
"""Parts of a trial; at the end of each but the last it is pruned if it is worse than most were by then."""


@dataclass(frozen=True)
class Tuning:
    """One tuning, as every process that works on it knows it."""

    config: ResolvedConfig
    """Where all settings start that are not searched; its own values are the first trial."""
    space: Space
    directory: Path
    options: RunOptions = dataclasses.field(default_factory=RunOptions)
    """Of the trials' runs."""
    storage: str | None = None
    """URL of a PostgreSQL database; SQLite in the directory otherwise."""
    trials: int = 50
    """Trials to finish, of all processes together."""
    seeds: int = 2
    """Trained for each trial."""
    workers: int = 1
    """Processes on this machine."""
    side_by_side: int = 1
    """Trials of a process in one compiled program."""
    sampler_seed: int = 0
    heartbeat: int = 20
    """Time between signs of life of a trial; one without for three times as long is taken over [s]."""

    @property
    def outside(self) -> dict[str, Any]:
        """The configuration's own values that are not among those searched; with any, it is no trial itself."""
        return {
            path: value
            for path, value in values_of(self.config, self.space).items()
            if value not in self.space[path]
        }

    def config_of(self, values: dict[str, Any]) -> ResolvedConfig:
        """What a trial trains; raises ConfigError if its values do not go together."""
        changed = with_values(self.config, values)
        return resolve(dataclasses.replace(changed, seed=FIRST_SEED, num_seeds=self.seeds))

    def best(self, values: dict[str, Any]) -> ResolvedConfig:
        """What is trained with the settings of a trial when the tuning is over."""
        return resolve(dataclasses.replace(with_values(self.config, values), seed=0, num_seeds=1))


def quarter(config: ResolvedConfig) -> int:
    """Iterations of a quarter of a run."""
    return -(-config.iterations // QUARTERS)


def value_of(result: dict[str, Any]) -> float:
    """What is maximised: the mean return of all seeds' episodes."""
    return float(result["return_mean"])
