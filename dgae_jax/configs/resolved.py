"""The resolved configuration: checked, complete and without optional settings.

`resolve` is the border: what lies below it takes a `ResolvedConfig` and checks nothing again.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dgae_jax.configs import validation
from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import (
    CommonConfig,
    Config,
    CriticConfig,
    PolicyConfig,
    Settings,
    invalid,
)
from dgae_jax.configs.parts import CRITICS, SGD, UPDATES
from dgae_jax.configs.validation import lookup


class Options(dict[str, Any]):
    """The settings of one part, to be passed to its function: `**options`; never changed."""

    def __hash__(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return hash(frozenset(self.items()))


@dataclass(frozen=True)
class ResolvedPolicy(Settings):
    """The policy network, the name of its update and what that takes."""

    hidden: tuple[int, ...]
    covariance: str
    initial_std: float
    update: str
    options: Options
    """Settings of the update."""


@dataclass(frozen=True)
class ResolvedCritic(Settings):
    """The value network, what it predicts and how it is fitted."""

    hidden: tuple[int, ...]
    kind: str
    target: str
    options: Options
    """Settings of this kind: `quantiles` and `kappa` of a distribution."""
    fit: Options
    """Settings of its gradient descent."""

    @property
    def is_distribution(self) -> bool:
        """True if the critic predicts quantiles."""
        return "quantiles" in self.options

    @property
    def outputs(self) -> int:
        """Numbers that the network predicts."""
        return self.options.get("quantiles", 1)


@dataclass(frozen=True, kw_only=True)
class ResolvedConfig(CommonConfig):
    """One training run with every setting that it uses, and no other. Made by `resolve`."""

    env_version: str | None
    """None for a task that has no versions."""
    algo: str
    residual: str
    physics: str
    policy: ResolvedPolicy
    critic: ResolvedCritic

    @property
    def task(self) -> str:
        """The task with its version, where it has one."""
        return f"{self.env}-{self.env_version}" if self.env_version else self.env

    def as_config(self) -> Config:
        """Return the same run as a user would write it out, to be changed and resolved again."""
        policy = PolicyConfig(**_merged(self.policy))
        critic = CriticConfig(**_merged(self.critic))
        return Config(**{**vars(self), "policy": policy, "critic": critic})


def resolve(config: Config | ResolvedConfig, algo: str | None = None) -> ResolvedConfig:
    """Check a configuration and fill in everything that is unset; a resolved one passes.

    Values that are traced by JAX pass unchecked.

    Args:
        config: the configuration.
        algo: name of the algorithm, where the configuration leaves it open.

    Raises:
        ConfigError: for the first setting that is invalid, alone or together with others.
    """
    if algo is not None and config.algo not in (None, algo):
        raise invalid("algo", config.algo, f"{algo} or unset")
    if isinstance(config, ResolvedConfig):
        return config
    validation.check_types(config)
    spec = validation.task_spec(config)
    algo = algo or config.algo or "dppo"
    row = lookup("algo", algo, ALGORITHMS)
    policy, critic = config.policy, config.critic
    update, kind = policy.update or row.policy_update, critic.kind or row.critic
    options = lookup("policy.update", update, UPDATES)
    shape = lookup("critic.kind", kind, CRITICS)
    validation.check_unused(f"{algo} (policy.update {update})", "policy", policy, options, UPDATES)
    validation.check_unused(f"{algo} (critic.kind {kind})", "critic", critic, shape, CRITICS)
    target, fit = critic.target or row.target, _filled(critic, SGD)
    resolved = ResolvedConfig(
        **{name: getattr(config, name) for name in CommonConfig.__dataclass_fields__},
        env_version=config.env_version or spec.default_version,
        algo=algo,
        residual=config.residual or row.residual,
        physics=config.physics or spec.engines[0],
        policy=ResolvedPolicy(
            policy.hidden, policy.covariance, policy.initial_std, update, _filled(policy, options)
        ),
        critic=ResolvedCritic(critic.hidden, kind, target, _filled(critic, shape), fit),
    )
    validation.check(resolved.as_config(), spec)
    return resolved


def _merged(settings: Settings) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    for name, value in vars(settings).items():
        merged |= value if isinstance(value, Options) else {name: value}
    return merged


def _filled(settings: Settings, defaults: Mapping[str, Any]) -> Options:
    chosen = {name: getattr(settings, name) for name in defaults}
    unset = {name: default for name, default in defaults.items() if chosen[name] is None}
    return Options({**chosen, **unset})
