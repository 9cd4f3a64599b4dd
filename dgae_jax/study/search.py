"""Search space of a tuning: settings, and the values that a trial may give to each.

`gamma=0.95:0.999` is a range, `policy.learning_rate=log:1e-4:1e-2` one on a logarithmic scale,
`num_envs=int:4:64` (or `int:log:4:64`) one of whole numbers and `critic.minibatches=16,32,64` a
choice. Widths of layers are written `64x64`.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.run.options import RunOptions

SHARED = ("env", "env_version", "algo", "physics", "total_steps", "episode_length")
"""Settings that say what is measured; all trials share them, and the seeds."""

FIRST_SEED = 1000
"""First seed of the trials; reports use 0, 1, …, which no choice of settings has seen."""


@dataclass(frozen=True)
class Values:
    """The values that trials may give to a setting."""

    text: str
    kind: str
    """float, int or categorical, as in the methods of Optuna's `Trial`."""
    ends: Sequence[Any]
    """Lowest and highest value, or all choices."""
    is_log: bool = False

    def suggest(self, trial: Any, path: str) -> Any:
        """Return the value that Optuna suggests for the setting in a trial."""
        if self.kind == "categorical":
            return trial.suggest_categorical(path, self.ends)
        return getattr(trial, f"suggest_{self.kind}")(path, *self.ends, log=self.is_log)

    def include(self, value: Any) -> bool:
        """Return whether a trial could give this value."""
        if self.kind == "categorical":
            return value in self.ends
        return self.ends[0] <= value <= self.ends[1]


@dataclass(frozen=True)
class Tuning:
    """One tuning, shared by all its processes; most fields are flags of `dgae tune`."""

    config: ResolvedConfig
    """Settings that are not searched; its values of those that are make the first trial."""
    space: dict[str, Values]
    """By dotted path of the setting."""
    directory: Path
    options: RunOptions = field(default_factory=RunOptions)
    storage: str | None = None
    """URL of a PostgreSQL database; None for SQLite in the directory."""
    trials: int = 50
    seeds: int = 2
    workers: int = 1
    sampler_seed: int = 0
    heartbeat: int = 20
    """Time between heartbeats; a trial without one for three times as long is retried [s]."""

    def trial_config(self, values: Mapping[str, Any]) -> ResolvedConfig:
        """Return the configuration of a trial; raise ConfigError if its values are invalid."""
        return _with_values(self.config, {**values, "seed": FIRST_SEED, "num_seeds": self.seeds})

    def start_values(self) -> dict[str, Any] | None:
        """Return the configuration's own values; None if one of them is outside the space."""
        values = {path: self.config.as_config().get(path) for path in self.space}
        values |= {k: "x".join(map(str, v)) for k, v in values.items() if isinstance(v, tuple)}
        return values if all(self.space[k].include(v) for k, v in values.items()) else None


def space_of(words: Sequence[str], config: ResolvedConfig) -> dict[str, Values]:
    """Parse and check each `SETTING=VALUES`; raise ConfigError for the first that is invalid."""
    space: dict[str, Values] = {}
    for word in words:
        name, _, text = word.partition("=")
        path = name.replace("-", "_")
        try:
            if path in (*SHARED, "seed", "num_seeds"):
                raise ConfigError(f"cannot be searched: all trials share {path}")
            if path in space:
                raise ConfigError(f"{path} is given twice")
            space[path] = _values(text)
            for value in space[path].ends:
                _with_values(config, {path: value})
        except ConfigError as reason:
            raise ConfigError(f"search {word}: {reason}", "search") from None
        except ValueError:
            forms = "LOW:HIGH, log:LOW:HIGH, int:LOW:HIGH, int:log:LOW:HIGH or VALUE,VALUE"
            raise invalid("search", word, f"SETTING={forms}, with LOW below HIGH") from None
    return space


def _values(text: str) -> Values:
    """Parse the part after `=`; raise ValueError."""
    if found := re.fullmatch(r"(int:)?(log:)?([^:,]+):([^:,]+)", text):
        kind, is_log = int if found[1] else float, bool(found[2])
        low, high = kind(found[3]), kind(found[4])
        if not low < high or (is_log and low <= 0):
            raise ValueError(text)
        return Values(text, kind.__name__, (low, high), is_log)
    choices = tuple(_choice(word) for word in text.split(","))
    if len(set(choices)) != len(choices) or len(choices) < 2 or "" in choices:
        raise ValueError(text)
    return Values(text, "categorical", choices)


def _choice(text: str) -> Any:
    """Parse a choice as JSON, or else as a name."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _with_values(config: ResolvedConfig, values: Mapping[str, Any]) -> ResolvedConfig:
    layers = {
        path: tuple(map(int, str(value).split("x")))
        for path, value in values.items()
        if path.endswith(".hidden") and re.fullmatch(r"\d+(x\d+)*", str(value))
    }
    return resolve(config.as_config().replace(**{**values, **layers}))
