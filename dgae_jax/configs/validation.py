"""Checks of a configuration: types, every setting alone, and all of them together.

Values that are traced by JAX are not known yet and pass unchecked.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal, get_args, get_origin, get_type_hints

from dgae_jax.configs import parts
from dgae_jax.configs.config import Config, ConfigError, Settings, invalid
from dgae_jax.envs.registry import EnvSpec, spec_of
from dgae_jax.maths.risk import check_metric
from dgae_jax.physics.registry import ENGINES, require

INT32_MAX = 2**31 - 1
"""The largest index and counter of a device."""

WHOLE = {
    "num_seeds": (1, 4096, "every one is a whole run in the same program"),
    "total_steps": (1, INT32_MAX, "samples are counted in an int32"),
    "num_envs": (1, INT32_MAX, "samples are indexed by an int32"),
    "num_steps": (1, INT32_MAX, "samples are indexed by an int32"),
    "episode_length": (1, INT32_MAX, "steps are counted in an int32"),
    "policy.epochs": (1, 10_000, "more passes over one rollout only fit its noise"),
    "policy.minibatches": (1, INT32_MAX, "samples are indexed by an int32"),
    "policy.cg_iterations": (1, 1000, "conjugate gradient loses orthogonality in float32 before"),
    "policy.max_backtracks": (0, 100, "a step halved more often is 0 in float32"),
    "policy.fisher_every": (1, INT32_MAX, "samples are indexed by an int32"),
    "critic.epochs": (1, 10_000, "more passes over one rollout only fit its noise"),
    "critic.minibatches": (1, INT32_MAX, "samples are indexed by an int32"),
    "critic.quantiles": (1, 10_000, "their residuals are K × K for every sample"),
}
"""Whole numbers: lowest, highest, and the reason for the highest."""

MAX_LAYERS, MAX_WIDTH = 32, 65_536
"""XLA compiles each layer by itself; one layer of this width has 17 GB of weights."""

UNIT = ("gamma", "gae_lambda", "policy.learning_rate_end", "critic.learning_rate_end")
"""Numbers from 0 to 1."""

POSITIVE = (
    "policy.clip_eps",
    "policy.initial_std",
    "policy.max_kl",
    "policy.damping",
    "policy.learning_rate",
    "policy.max_grad_norm",
    "critic.learning_rate",
    "critic.max_grad_norm",
    "critic.kappa",
)
"""Numbers above 0."""

CHOICES = {
    "policy.covariance": parts.COVARIANCES,
    "policy.optimizer": parts.OPTIMIZERS,
    "critic.optimizer": parts.OPTIMIZERS,
    "critic.target": parts.TARGETS,
    "residual": parts.RESIDUALS,
}
"""Names, and the table that each must be in."""


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
            plain = _plain(kind)
            shown = getattr(get_origin(plain) or plain, "__name__", plain)
            raise ConfigError(f"{path}: must be {shown}, not {value!r}", path)


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
    _check_each(config)
    _check_networks(config)
    _check_metric(config)
    _check_samples(config)


def _require(setting: str, value: Any, ok: bool, allowed: str) -> None:
    if not ok:
        raise invalid(setting, value, allowed)


def _known(config: Config, path: str) -> Any:
    """Return the value of a setting; None where it is unset or traced."""
    value = config.get(path)
    return value if isinstance(value, int | float | str | tuple) else None


def _check_task(config: Config, spec: EnvSpec) -> None:
    lookup("physics", config.physics, dict.fromkeys(spec.engines))
    try:
        if config.physics in ENGINES:
            require(str(config.physics))
    except ValueError as reason:
        raise ConfigError(str(reason), "physics") from None
    if spec.versions:
        lookup("env_version", config.env_version, dict.fromkeys(spec.versions))
    else:
        only = f"unset with {config.env}"
        _require("env_version", config.env_version, config.env_version is None, only)
        _require("noise.initial", config.noise.initial, config.noise.initial == 0, only)
    for name, std in dataclasses.asdict(config.noise).items():
        ok = std >= 0 and math.isfinite(std)
        _require(f"noise.{name}", std, ok, "a finite number of at least 0")


def _check_each(config: Config) -> None:
    for path, (low, high, reason) in WHOLE.items():
        if (value := _known(config, path)) is not None:
            allowed = f"a whole number from {low:,} to {high:,} ({reason})"
            _require(path, value, low <= value <= high, allowed)
    for path in UNIT:
        if (value := _known(config, path)) is not None:
            _require(path, value, 0 <= value <= 1, "a number from 0 to 1")
    for path in POSITIVE:
        if (value := _known(config, path)) is not None:
            _require(path, value, 1e-30 <= value <= 1e30, "a number above 0, from 1e-30 to 1e30")
    for path, table in CHOICES.items():
        if (value := _known(config, path)) is not None:
            lookup(path, value, table)
    highest = 2**32 - config.num_seeds
    allowed = f"a whole number from 0 to {highest:,} (seeds are numbers of 32 bits)"
    _require("seed", config.seed, 0 <= config.seed <= highest, allowed)


def _check_networks(config: Config) -> None:
    for path in ("policy.hidden", "critic.hidden"):
        hidden = config.get(path)
        ok = len(hidden) >= 1 and min(hidden) >= 1
        _require(path, hidden, ok, "one or more widths of at least 1")
        allowed = f"widths of at most {MAX_WIDTH:,} (one layer of them has 17 GB of weights)"
        _require(path, hidden, max(hidden) <= MAX_WIDTH, allowed)
        if len(hidden) > MAX_LAYERS:
            allowed = f"at most {MAX_LAYERS} (XLA compiles a thousand for half an hour)"
            raise ConfigError(f"{path} of {len(hidden):,} layers: must be {allowed}", path)


def _check_metric(config: Config) -> None:
    try:
        check_metric(config.metric)
    except ValueError as allowed:
        raise invalid("metric", config.metric, str(allowed)) from None
    distribution = "quantiles" in parts.CRITICS[str(config.critic.kind)]
    used = config.metric == "mean" or (config.residual == "distributional" and distribution)
    allowed = f"mean with {config.algo}: other metrics need a distributional residual and quantiles"
    _require("metric", config.metric, used, allowed)
    ok = distribution or not config.diagnostics
    _require("diagnostics", config.diagnostics, ok, "off: the critic is scalar")


def _check_samples(config: Config) -> None:
    samples = config.samples_per_iteration
    allowed = f"such that num_envs * num_steps is at most {INT32_MAX:,}"
    _require("num_envs", config.num_envs, samples <= INT32_MAX, allowed)
    for path in ("policy.minibatches", "critic.minibatches"):
        if (value := _known(config, path)) is not None:
            allowed = f"a divisor of num_envs * num_steps = {samples:,}"
            _require(path, value, samples % value == 0, allowed)
    if (every := _known(config, "policy.fisher_every")) is not None:
        allowed = f"at most num_envs * num_steps = {samples:,}"
        _require("policy.fisher_every", every, every <= samples, allowed)
    if (total := _known(config, "total_steps")) is not None:
        allowed = f"at least one iteration of num_envs * num_steps = {samples:,} samples"
        _require("total_steps", total, total >= samples, allowed)
