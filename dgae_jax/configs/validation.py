"""Checks of a configuration: types, every setting alone, and all of them together.

Values that are traced by JAX are not known yet and pass unchecked.
"""

import dataclasses
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, get_args, get_origin, get_type_hints

from dgae_jax.configs import parts
from dgae_jax.configs.config import Config, ConfigError, Settings, flat, invalid
from dgae_jax.envs.registry import EnvSpec, spec_of
from dgae_jax.maths import risk
from dgae_jax.physics.registry import ENGINES, require

INT32_MAX = 2**31 - 1  # the largest index and counter of a device

MAX_LAYERS, MAX_WIDTH = 32, 65_536


def _whole(low: int, high: int, reason: str) -> tuple[int, int, str]:
    return low, high, f"a whole number from {low:,} to {high:,} ({reason})"


UNIT = 0, 1, "a number from 0 to 1"
POSITIVE = 1e-30, 1e30, "a number above 0, from 1e-30 to 1e30"
STD = 0, sys.float_info.max, "a finite number of at least 0"
SAMPLES = _whole(1, INT32_MAX, "samples are indexed by an int32")

RANGES: dict[str, tuple[float, float, str]] = {
    "num_seeds": _whole(1, 4096, "every one is a whole run in the same program"),
    "total_steps": _whole(1, INT32_MAX, "samples are counted in an int32"),
    "num_envs": SAMPLES,
    "num_steps": SAMPLES,
    "episode_length": _whole(1, INT32_MAX, "steps are counted in an int32"),
    "gamma": UNIT,
    "gae_lambda": UNIT,
    "initial_std": POSITIVE,
    "learning_rate": POSITIVE,
    "learning_rate_end": UNIT,
    "epochs": _whole(1, 10_000, "more passes over one rollout only fit its noise"),
    "minibatches": SAMPLES,
    "max_grad_norm": POSITIVE,
    "clip_eps": POSITIVE,
    "max_kl": POSITIVE,
    "damping": POSITIVE,
    "cg_iterations": _whole(1, 1000, "float32 directions are not conjugate beyond"),
    "max_backtracks": _whole(0, 100, "a step halved more often is 0 in float32"),
    "fisher_every": SAMPLES,
    "quantiles": _whole(1, 10_000, "their residuals are K × K for every sample"),
    "kappa": POSITIVE,
    "reward": STD,
    "action": STD,
    "observation": STD,
    "initial": STD,
}
"""By name of a number: its lowest and highest value, and how an error message says so."""

CHOICES = {
    "covariance": parts.COVARIANCES,
    "optimizer": parts.OPTIMIZERS,
    "target": parts.TARGETS,
    "residual": parts.RESIDUALS,
}
"""By name of a setting: the table that its value must be in."""


def lookup(setting: str, name: Any, table: Mapping[str, Any]) -> Any:
    """Return the entry of a table; raise ConfigError, listing the names, for an unknown one."""
    if not isinstance(name, str) or name not in table:
        raise invalid(setting, name, f"one of {', '.join(table)}")
    return table[name]


def task_spec(config: Config, setting: str = "env") -> EnvSpec:
    """Return the spec of the configuration's task; raise ConfigError for an unknown one."""
    try:
        return spec_of(config.env)
    except ValueError as allowed:
        raise invalid(setting, config.env, str(allowed)) from None


def check_types(settings: Settings, prefix: str = "") -> None:
    """Raise ConfigError for a setting of the wrong type; arrays pass for numbers."""
    for name, kind in get_type_hints(type(settings)).items():
        value, path = getattr(settings, name), prefix + name
        if dataclasses.is_dataclass(kind):
            if not isinstance(value, kind):  # pyright: ignore[reportArgumentType]
                raise ConfigError(f"{path} {value!r}: must be {kind.__name__}", path)
            check_types(value, f"{path}.")
        elif not _has_type(value, kind):
            plain = get_origin(_plain(kind)) or _plain(kind)
            raise ConfigError(f"{path}: must be {plain.__name__}, not {value!r}", path)


def _plain(kind: Any) -> Any:
    """Return the type behind `| None`, and str for a choice of names, which may be registered."""
    if type(None) in get_args(kind):
        kind = get_args(kind)[0]
    return str if get_origin(kind) is Literal else kind


def _has_type(value: Any, kind: Any) -> bool:
    if value is None:
        return type(None) in get_args(kind)
    if hasattr(value, "dtype"):
        return True
    kind = _plain(kind)
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(type(each) is int for each in value)
    return type(value) is kind


def check_unused(
    who: str, group: str, settings: Settings, used: Mapping[str, Any], table: Mapping[str, Any]
) -> None:
    """Raise ConfigError for a setting that only other parts of `table` would use."""
    for name in sorted({option for each in table.values() for option in each} - set(used)):
        if (value := getattr(settings, name)) is not None:
            raise invalid(f"{group}.{name}", value, f"unset: it has no effect with {who}")


def check(config: Config, spec: EnvSpec) -> None:
    """Raise ConfigError for the first invalid setting of a configuration that is filled in."""
    _check_task(config, spec)
    for path in flat(dataclasses.asdict(config)):
        name = path.rpartition(".")[2]
        if name in RANGES:
            low, high, allowed = RANGES[name]
            _require(config, path, partial(_within, low, high), allowed)
        if name in CHOICES:
            _require(config, path, CHOICES[name].__contains__, f"one of {', '.join(CHOICES[name])}")
    highest = 2**32 - config.num_seeds
    allowed = f"a whole number from 0 to {highest:,} (seeds are numbers of 32 bits)"
    _require(config, "seed", lambda seed: 0 <= seed <= highest, allowed)
    _check_networks(config)
    _check_metric(config)
    _check_samples(config)


def _within(low: float, high: float, value: Any) -> bool:
    return low <= value <= high


def _require(config: Config, path: str, ok: Callable[[Any], bool], allowed: str) -> None:
    """Raise ConfigError unless a setting is valid, or unset or traced and so not known."""
    value = config.get(path)
    if isinstance(value, int | float | str | tuple) and not ok(value):
        raise invalid(path, value, allowed)


def _check_task(config: Config, spec: EnvSpec) -> None:
    lookup("physics", config.physics, dict.fromkeys(spec.engines))
    try:
        if config.physics in ENGINES:
            require(str(config.physics))
    except ValueError as reason:
        raise ConfigError(str(reason), "physics") from None
    if spec.eval_envs:
        lookup("env_version", config.env_version, spec.eval_envs)
    else:
        only = f"unset with {config.env}"
        _require(config, "env_version", lambda version: False, only)
        _require(config, "noise.initial", lambda std: std == 0, only)


def _check_networks(config: Config) -> None:
    widths = f"one or more widths from 1 to {MAX_WIDTH:,} (one layer of such has 17 GB of weights)"
    layers = f"at most {MAX_LAYERS} (XLA compiles a thousand for half an hour)"
    for path in ("policy.hidden", "critic.hidden"):
        _require(config, path, lambda x: x and 1 <= min(x) <= max(x) <= MAX_WIDTH, widths)
        if (count := len(config.get(path))) > MAX_LAYERS:
            raise ConfigError(f"{path} of {count:,} layers: must be {layers}", path)


def _check_metric(config: Config) -> None:
    try:
        risk.parse(config.metric)
    except ValueError as allowed:
        raise invalid("metric", config.metric, str(allowed)) from None
    distribution = "quantiles" in parts.CRITICS[str(config.critic.kind)]
    if not (distribution and config.residual == "distributional"):
        needs = "other metrics need a distributional residual and quantiles"
        allowed = f"mean with {config.algo}: {needs}"
        _require(config, "metric", lambda metric: metric == "mean", allowed)
    if not distribution:
        _require(config, "diagnostics", lambda on: not on, "off: the critic is scalar")


def _check_samples(config: Config) -> None:
    samples = config.samples_per_iteration
    of_samples = f"num_envs * num_steps = {samples:,}"
    allowed = f"such that num_envs * num_steps is at most {INT32_MAX:,}"
    _require(config, "num_envs", lambda _: samples <= INT32_MAX, allowed)
    for path in ("policy.minibatches", "critic.minibatches"):
        _require(config, path, lambda n: samples % n == 0, f"a divisor of {of_samples}")
    _require(config, "policy.fisher_every", lambda n: n <= samples, f"at most {of_samples}")
    allowed = f"at least one iteration of {of_samples} samples"
    _require(config, "total_steps", lambda total: total >= samples, allowed)
