"""What a configuration may be: every setting alone, and all of them together."""

import dataclasses
import math
from typing import Any

from dgae_jax.configs.algorithms import TABLE
from dgae_jax.configs.config import Config, ConfigError, PolicyConfig, flag, resolve
from dgae_jax.envs.registry import BRAX, make_env, spec_of
from dgae_jax.learn.critics import CRITICS, RESIDUALS, TARGETS
from dgae_jax.learn.networks import COVARIANCES
from dgae_jax.learn.updates import OPTIMIZERS, UPDATES
from dgae_jax.maths.risk import weights_of
from dgae_jax.physics.registry import ENGINES

LARGEST = 2**31 - 1

_PARTS = (("policy", "update", UPDATES), ("critic", "kind", CRITICS), ("critic", "target", TARGETS))


def _check(path: str, value: Any, ok: bool, allowed: str) -> None:
    if not ok:
        shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
        raise ConfigError(f"{flag(path)} {shown}: must be {allowed}")


def _choice(path: str, value: str, table: Any) -> None:
    _check(path, value, value in table, f"one of {', '.join(table)}")


def _positive(path: str, value: int) -> None:
    _check(path, value, 1 <= value <= LARGEST, f"a whole number of at least 1 and at most {LARGEST:,}")


def _between(path: str, value: float, low: float, high: float) -> None:
    _check(path, value, low <= value <= high, f"a number from {low:g} to {high:g}")


def _above_zero(path: str, value: float) -> None:
    _check(path, value, 1e-30 <= value <= 1e30, "a number above 0, from 1e-30 to 1e30")


def validate(config: Config) -> None:
    """Raise `ConfigError` for the first setting that cannot be, alone or together with the others."""
    try:
        spec = spec_of(config.env)
    except ValueError as allowed:
        raise ConfigError(f"--env {config.env}: must be {allowed}") from None
    _choice("env_version", config.env_version, spec.versions or (Config.env_version,))
    _choice("algo", config.algo, TABLE)
    _choice("physics", config.physics, ENGINES)
    if config.env.startswith(BRAX):
        _validate_brax(config)
    for name in ("num_seeds", "total_steps", "num_envs", "horizon", "episode_length"):
        _positive(name, getattr(config, name))
    highest = 2**32 - config.num_seeds
    _check("seed", config.seed, 0 <= config.seed <= highest, f"a whole number from 0 to {highest:,}")
    _check("num_envs", config.num_envs, config.samples <= LARGEST, f"such that num_envs * horizon is at most {LARGEST:,}")
    _between("gamma", config.gamma, 0, 1)
    _between("lam", config.lam, 0, 1)
    _choice("policy.covariance", config.policy.covariance, COVARIANCES)
    _choice("residual", config.residual, ("default", *RESIDUALS))
    for part, name, table in _PARTS:
        _choice(f"{part}.{name}", getattr(getattr(config, part), name), ("default", *table))
    _validate_policy(config.policy)
    for name, deviation in dataclasses.asdict(config.noise).items():
        _check(f"noise.{name}", deviation, deviation >= 0 and math.isfinite(deviation), "a finite number of at least 0")
    _positive("critic.quantiles", config.critic.quantiles)
    _above_zero("critic.kappa", config.critic.kappa)
    for part in ("policy", "critic"):
        _validate_fit(config, part)
    _validate_use(config)
    if config.iterations < 1:
        _check("total_steps", config.total_steps, False, f"at least one iteration of num_envs * horizon = {config.samples:,} samples")


def _validate_brax(config: Config) -> None:
    try:
        make_env(config.env)
    except (ValueError, TypeError) as reason:
        _check("env", config.env, False, f"an environment that Brax can build on mjx ({reason})")
    _check("physics", config.physics, config.physics == "jax", f"mjx with an environment of Brax's own ({config.env})")
    _check("noise.initial", config.noise.initial, config.noise.initial == 0, "left out with an environment of Brax's own")


def _validate_policy(settings: PolicyConfig) -> None:
    for name in ("clip", "initial_std", "radius", "damping"):
        _above_zero(f"policy.{name}", getattr(settings, name))
    for name in ("cg_iterations", "fisher_every"):
        _positive(f"policy.{name}", getattr(settings, name))
    _check("policy.backtracks", settings.backtracks, settings.backtracks >= 0, "a whole number of at least 0")


def _validate_fit(config: Config, part: str) -> None:
    settings = getattr(config, part)
    _check(f"{part}.hidden", settings.hidden, len(settings.hidden) >= 1 and min(settings.hidden) >= 1, "one or more widths of at least 1")
    _choice(f"{part}.optimizer", settings.optimizer, OPTIMIZERS)
    _above_zero(f"{part}.learning_rate", settings.learning_rate)
    _between(f"{part}.learning_rate_end", settings.learning_rate_end, 0, 1)
    _above_zero(f"{part}.max_grad_norm", settings.max_grad_norm)
    _positive(f"{part}.epochs", settings.epochs)
    _positive(f"{part}.minibatches", settings.minibatches)
    if part == "critic" or "minibatches" in UPDATES[resolve(config).policy.update].options:
        divides = config.samples % settings.minibatches == 0
        _check(f"{part}.minibatches", settings.minibatches, divides, f"a divisor of num_envs * horizon = {config.samples:,}")


def _validate_use(config: Config) -> None:
    """No setting that the parts of this run have no use for."""
    full = resolve(config)
    for part, group, chosen, table in (
        ("policy", config.policy, full.policy.update, UPDATES),
        ("critic", config.critic, full.critic.kind, CRITICS),
    ):
        for name in sorted({option for each in table.values() for option in each.options} - set(table[chosen].options)):
            value, default = getattr(group, name), getattr(type(group)(), name)
            _check(f"{part}.{name}", value, value == default, f"left out: {config.algo} with {chosen} does not use it")
    try:
        weights_of(config.metric, full.critic.quantiles)
    except ValueError as allowed:
        _check("metric", config.metric, False, str(allowed))
    calibrated = not config.diagnostics or full.critic.kind == "quantile"
    _check("diagnostics", config.diagnostics, calibrated, f"left out: the critic of {config.algo} is no distribution")
    used = config.metric == "mean" or (full.residual == "distributional" and full.critic.kind == "quantile")
    _check("metric", config.metric, used, "mean, or used with a distributional residual and a quantile critic")
