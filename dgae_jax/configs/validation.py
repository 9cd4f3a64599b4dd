"""What a configuration may be: every setting alone, and all of them together. Nothing here imports JAX.

Values that are traced are not known yet and pass unchecked.
"""

import dataclasses
import math
from typing import Any

from dgae_jax.configs.config import Config, ConfigError, invalid, lookup, resolve, task_spec
from dgae_jax.configs.parts import COVARIANCES, CRITICS, OPTIMIZERS, RESIDUALS, TARGETS, UPDATES, is_distribution
from dgae_jax.configs.serial import check_types
from dgae_jax.maths.risk import check_metric
from dgae_jax.physics.registry import ENGINES, require

LARGEST = 2**31 - 1
"""What an int32, the largest index and counter of a device, can hold."""

WHOLE = {
    "num_seeds": (1, 4096, "every one is a whole run in the same program"),
    "total_steps": (1, LARGEST, "samples are counted in an int32"),
    "num_envs": (1, LARGEST, "samples are indexed by an int32"),
    "horizon": (1, LARGEST, "samples are indexed by an int32"),
    "episode_length": (1, LARGEST, "steps are counted in an int32"),
    "policy.epochs": (1, 10_000, "a pass more often over one rollout only fits its noise"),
    "policy.minibatches": (1, LARGEST, "samples are indexed by an int32"),
    "policy.cg_iterations": (1, 1000, "conjugate gradient has lost its orthogonality in float32 long before"),
    "policy.backtracks": (0, 100, "a step halved more often is 0 in float32"),
    "policy.fisher_every": (1, LARGEST, "samples are indexed by an int32"),
    "critic.epochs": (1, 10_000, "a pass more often over one rollout only fits its noise"),
    "critic.minibatches": (1, LARGEST, "samples are indexed by an int32"),
    "critic.quantiles": (1, 10_000, "their residuals are K × K for every sample"),
}
"""Whole numbers: from, to, and why not more."""

LAYERS, WIDTH = 32, 65_536
"""Most hidden layers and units in one: XLA compiles each layer by itself, and a layer this wide fills a large device."""

UNIT = ("gamma", "lam", "policy.learning_rate_end", "critic.learning_rate_end")
"""Numbers from 0 to 1."""

POSITIVE = (
    "policy.clip", "policy.initial_std", "policy.radius", "policy.damping", "policy.learning_rate", "policy.max_grad_norm",
    "critic.learning_rate", "critic.max_grad_norm", "critic.kappa",
)  # fmt: skip
"""Numbers above 0."""

CHOICES = {
    "policy.covariance": COVARIANCES, "policy.optimizer": OPTIMIZERS, "critic.optimizer": OPTIMIZERS, "critic.target": TARGETS,
    "residual": RESIDUALS,
}  # fmt: skip


def validate(config: Config) -> Config:
    """The configuration resolved, with everything unset that the run uses written out.

    Raises ConfigError for the first setting that is invalid, alone or together with the others.
    """
    check_types(config)
    full = resolve(config)
    _check_task(full)
    _check_each(full)
    _check_networks(full)
    _check_use(full)
    _check_samples(full)
    return full


def _check(setting: str, value: Any, ok: bool, allowed: str) -> None:
    if not ok:
        raise invalid(setting, value, allowed)


def _get(config: Config, path: str) -> Any:
    """The value of a setting; None where it is unset or traced."""
    value: Any = config
    for name in path.split("."):
        value = getattr(value, name)
    return value if isinstance(value, int | float | str | tuple) else None


def _check_task(config: Config) -> None:
    spec = task_spec(config)
    lookup("physics", config.physics, dict.fromkeys(spec.engines))
    try:
        if config.physics in ENGINES:
            require(str(config.physics))
    except ValueError as reason:
        raise ConfigError(str(reason), "physics") from None
    if spec.versions:
        lookup("env_version", config.env_version, dict.fromkeys(spec.versions))
    else:
        _check("env_version", config.env_version, config.env_version is None, f"left out with {config.env}")
        _check("noise.initial", config.noise.initial, config.noise.initial == 0, f"left out with {config.env}")
    for name, std in dataclasses.asdict(config.noise).items():
        _check(f"noise.{name}", std, std >= 0 and math.isfinite(std), "a finite number of at least 0")


def _check_each(config: Config) -> None:
    for path, (low, high, reason) in WHOLE.items():
        if (value := _get(config, path)) is not None:
            _check(path, value, low <= value <= high, f"a whole number from {low:,} to {high:,} ({reason})")
    for path in UNIT:
        if (value := _get(config, path)) is not None:
            _check(path, value, 0 <= value <= 1, "a number from 0 to 1")
    for path in POSITIVE:
        if (value := _get(config, path)) is not None:
            _check(path, value, 1e-30 <= value <= 1e30, "a number above 0, from 1e-30 to 1e30")
    for path, table in CHOICES.items():
        if (value := _get(config, path)) is not None:
            lookup(path, value, table)
    highest = 2**32 - config.num_seeds
    _check("seed", config.seed, 0 <= config.seed <= highest, f"a whole number from 0 to {highest:,} (seeds are numbers of 32 bits)")


def _check_networks(config: Config) -> None:
    for path in ("policy.hidden", "critic.hidden"):
        hidden = _get(config, path)
        _check(path, hidden, len(hidden) >= 1 and min(hidden) >= 1, "one or more widths of at least 1")
        _check(path, hidden, max(hidden) <= WIDTH, f"widths of at most {WIDTH:,} (one layer of them has 17 GB of weights)")
        if len(hidden) > LAYERS:
            raise ConfigError(
                f"{path} of {len(hidden):,} layers: must be at most {LAYERS} (XLA compiles a thousand for half an hour)", path
            )


def _check_use(config: Config) -> None:
    """No setting that the parts of this run do not use."""
    for part, group, chosen, table in (
        ("policy", config.policy, config.policy.update, UPDATES),
        ("critic", config.critic, config.critic.kind, CRITICS),
    ):
        unused = {option for each in table.values() for option in each.options} - set(lookup(part, chosen, table).options)
        for name in sorted(unused):
            value = getattr(group, name)
            _check(f"{part}.{name}", value, value is None, f"left out: {config.algo} with {chosen} does not use it")
    try:
        check_metric(config.metric)
    except ValueError as allowed:
        raise invalid("metric", config.metric, str(allowed)) from None
    distribution = is_distribution(str(config.critic.kind))
    _check("diagnostics", config.diagnostics, distribution or not config.diagnostics, f"left out: the critic of {config.algo} is scalar")
    used = config.metric == "mean" or (config.residual == "distributional" and distribution)
    _check("metric", config.metric, used, f"mean with {config.algo}: other metrics need a distributional residual and a quantile critic")


def _check_samples(config: Config) -> None:
    samples = config.samples_per_iteration
    _check("num_envs", config.num_envs, samples <= LARGEST, f"such that num_envs * horizon is at most {LARGEST:,}")
    for path in ("policy.minibatches", "critic.minibatches"):
        if (minibatches := _get(config, path)) is not None:
            _check(path, minibatches, samples % minibatches == 0, f"a divisor of num_envs * horizon = {samples:,}")
    if (every := _get(config, "policy.fisher_every")) is not None:
        _check("policy.fisher_every", every, every <= samples, f"at most num_envs * horizon = {samples:,}")
    if _get(config, "total_steps") is not None:
        enough = config.total_steps >= samples
        _check("total_steps", config.total_steps, enough, f"at least one iteration of num_envs * horizon = {samples:,} samples")
