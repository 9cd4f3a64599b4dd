"""Search space of a tuning: settings, and the values of each as an Optuna distribution.

`gamma=0.95:0.999` is a range, `policy.learning_rate=log:1e-4:1e-2` one on a logarithmic scale,
`num_envs=int:4:64` (or `int:log:4:64`) one of whole numbers and `critic.minibatches=16,32,64` a
choice. Widths of layers are written `64x64`. Nothing here imports JAX.
"""

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.run.options import RunOptions

Distribution = FloatDistribution | IntDistribution | CategoricalDistribution

Space = dict[str, Distribution]
"""The values of each setting, by its dotted path."""

FIXED = ("env", "env_version", "algo", "physics", "total_steps", "episode_length")
"""Settings that all trials share, because they say what is measured; seeds are shared too."""

FIRST_SEED = 1000
"""First seed of the trials; reports use 0, 1, …, which no choice of settings has seen."""

MAX_LISTED = 1000
"""Ranges of fewer whole numbers are checked number by number."""


@dataclass(frozen=True)
class Tuning:
    """One tuning, as every process that works on it knows it."""

    config: ResolvedConfig
    """Settings that are not searched; its values of those that are make the first trial."""
    space: Space
    directory: Path
    options: RunOptions = dataclasses.field(default_factory=RunOptions)
    """Options of the trials' runs."""
    storage: str | None = None
    """URL of a PostgreSQL database; None for SQLite in the directory."""
    trials: int = 50
    """Trials to finish, by all processes together."""
    seeds: int = 2
    """Seeds that each trial trains."""
    workers: int = 1
    """Processes on this machine."""
    sampler_seed: int = 0
    heartbeat: int = 20
    """Time between heartbeats; a trial without one for three times as long is retried [s]."""

    def trial_config(self, values: Mapping[str, Any]) -> ResolvedConfig:
        """Return the configuration of a trial; raise ConfigError if its values are invalid."""
        seeds = {"seed": FIRST_SEED, "num_seeds": self.seeds}
        return with_values(self.config, {**values, **seeds})

    def best_config(self, values: Mapping[str, Any]) -> ResolvedConfig:
        """Return the configuration to train with the values of the best trial."""
        return with_values(self.config, {**values, "seed": 0, "num_seeds": 1})

    def start_values(self) -> dict[str, Any] | None:
        """Return the configuration's own values; None if one of them is outside the space."""
        values = values_of(self.config, self.space)
        return values if all(_holds(self.space[path], values[path]) for path in values) else None


def space_of(words: Sequence[str], config: ResolvedConfig) -> Space:
    """Parse what is to be searched, and check it against the rest of the configuration.

    Args:
        words: `SETTING=VALUES`, as in the docstring of this module.
        config: values of all other settings.

    Raises:
        ConfigError: a setting is unknown, fixed or has no effect, or a value is invalid.
    """
    space: Space = {}
    for word in words:
        name, _, text = word.partition("=")
        path = name.replace("-", "_")
        if path in (*FIXED, "seed", "num_seeds"):
            raise invalid("search", word, f"of another setting: all trials share {path}")
        if path in space:
            raise invalid("search", word, f"the only range of {path}")
        try:
            space[path] = _distribution(text)
        except ValueError:
            forms = "LOW:HIGH, log:LOW:HIGH, int:LOW:HIGH, int:log:LOW:HIGH or VALUE,VALUE"
            raise invalid("search", word, f"SETTING={forms}, with LOW below HIGH") from None
        for value in _examples(space[path]):
            try:
                with_values(config, {path: value})
            except ConfigError as reason:
                raise invalid("search", word, f"valid throughout ({reason})") from None
    return space


def with_values(config: ResolvedConfig, values: Mapping[str, Any]) -> ResolvedConfig:
    """Return the configuration with some settings, by path, replaced and all checked again."""
    settings = {path: _setting(path, value) for path, value in values.items()}
    return resolve(config.as_config().replace(**settings))


def values_of(config: ResolvedConfig, space: Space) -> dict[str, Any]:
    """Return the values of the searched settings, as a trial keeps them."""
    values = {path: config.as_config().get(path) for path in space}
    layers = {k: "x".join(map(str, v)) for k, v in values.items() if isinstance(v, tuple)}
    return values | layers


def shown(distribution: Distribution) -> str:
    """Return a distribution as it is written on the command line."""
    if isinstance(distribution, CategoricalDistribution):
        return ",".join(map(str, distribution.choices))
    kind = "int:" if isinstance(distribution, IntDistribution) else ""
    scale = "log:" if distribution.log else ""
    return f"{kind}{scale}{distribution.low:g}:{distribution.high:g}"


def _distribution(text: str) -> Distribution:
    """Parse the part after `=`; raise ValueError."""
    if found := re.fullmatch(r"(int:)?(log:)?([^:,]+):([^:,]+)", text):
        whole, log, low, high = found.groups()
        if not float(low) < float(high):
            raise ValueError(text)
        if whole:
            return IntDistribution(int(low), int(high), log=bool(log))
        return FloatDistribution(float(low), float(high), log=bool(log))
    choices = [_value(each) for each in text.split(",")]
    if len(set(choices)) != len(choices) or len(choices) < 2 or "" in choices:
        raise ValueError(text)
    return CategoricalDistribution(choices)


def _value(text: str) -> Any:
    """Parse a choice as JSON, or else as a name."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _setting(path: str, value: Any) -> Any:
    is_layers = path.endswith(".hidden") and re.fullmatch(r"\d+(x\d+)*", str(value))
    return tuple(map(int, str(value).split("x"))) if is_layers else value


def _examples(distribution: Distribution) -> Sequence[Any]:
    """Return values that must be valid for all of them to be."""
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices
    low, high = distribution.low, distribution.high
    if isinstance(distribution, IntDistribution) and high - low < MAX_LISTED:
        return range(distribution.low, distribution.high + 1)
    return low, high


def _holds(distribution: Distribution, value: Any) -> bool:
    if isinstance(distribution, CategoricalDistribution):
        return value in distribution.choices
    return distribution.low <= value <= distribution.high
