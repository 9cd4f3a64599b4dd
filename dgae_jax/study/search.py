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

from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.run.options import RunOptions

SHARED = (
    *("env", "env_version", "algo", "physics", "total_steps", "episode_length"),
    *("seed", "num_seeds"),
)
"""Settings that say what is measured; all trials share them."""

FIRST_SEED = 1000
"""First seed of the trials; reports use 0, 1, …, which no choice of settings has seen."""


Values = FloatDistribution | IntDistribution | CategoricalDistribution
"""The values that trials may give to a setting."""


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
    trials: int = 50
    seeds: int = 2
    workers: int = 1
    sampler_seed: int = 0

    def trial_config(self, values: Mapping[str, Any]) -> ResolvedConfig:
        """Return the configuration of a trial; raise ConfigError if its values are invalid."""
        return _with_values(self.config, {**values, "seed": FIRST_SEED, "num_seeds": self.seeds})

    def start_values(self) -> dict[str, Any]:
        """Return the configuration's own values of what is searched."""
        values = {path: self.config.as_config().get(path) for path in self.space}
        return {k: "x".join(map(str, v)) if isinstance(v, tuple) else v for k, v in values.items()}


def space_of(words: Sequence[str], config: ResolvedConfig) -> dict[str, Values]:
    """Parse and check each `SETTING=VALUES`; raise ConfigError for the first that is invalid."""
    space: dict[str, Values] = {}
    for word in words:
        name, _, text = word.partition("=")
        path = name.replace("-", "_")
        try:
            if path in SHARED:
                raise ConfigError(f"cannot be searched: all trials share {path}")
            if path in space:
                raise ConfigError(f"{path} is given twice")
            space[path], values = _values(text)
            for value in values:
                _with_values(config, {path: value})
        except ValueError as reason:
            forms = "LOW:HIGH, log:LOW:HIGH, int:LOW:HIGH, int:log:LOW:HIGH or VALUE,VALUE"
            raise invalid("search", word, f"SETTING={forms} ({reason})") from None
    return space


def _values(text: str) -> tuple[Values, Sequence[Any]]:
    """Parse the part after `=`, also to both ends or all choices; raise ValueError."""
    if found := re.fullmatch(r"(int:)?(log:)?([^:,]+):([^:,]+)", text):
        is_int, is_log, low, high = found.groups()
        kind: Any = IntDistribution if is_int else FloatDistribution
        values = [int(low), int(high)] if is_int else [float(low), float(high)]
        return kind(*values, log=bool(is_log)), values
    choices = [_choice(word) for word in text.split(",") if word]
    return CategoricalDistribution(choices), choices


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
