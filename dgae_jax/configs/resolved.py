"""The resolved configuration: checked, complete and without optional settings.

`resolve` is the border: what lies below it takes a `ResolvedConfig` and checks nothing again.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from dgae_jax.configs import validation
from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import (
    CommonConfig,
    Config,
    ConfigError,
    CriticConfig,
    PolicyConfig,
    Settings,
)
from dgae_jax.configs.parts import CRITICS, SGD, UPDATES
from dgae_jax.configs.validation import lookup


@dataclass(frozen=True)
class Options(Mapping[str, Any]):
    """The settings of one part, to be passed to its function: `**options`; hashable."""

    pairs: tuple[tuple[str, Any], ...] = ()

    def __getitem__(self, name: str) -> Any:
        return dict(self.pairs)[name]

    def __iter__(self) -> Iterator[str]:
        return iter(dict(self.pairs))

    def __len__(self) -> int:
        return len(self.pairs)


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
        policy, critic = self.policy, self.critic
        return Config(
            **{
                name: value
                for name, value in vars(self).items()
                if name not in ("policy", "critic")
            },
            policy=PolicyConfig(
                hidden=policy.hidden,
                covariance=policy.covariance,  # pyright: ignore[reportArgumentType]
                initial_std=policy.initial_std,
                update=policy.update,  # pyright: ignore[reportArgumentType]
                **policy.options,
            ),
            critic=CriticConfig(
                hidden=critic.hidden,
                kind=critic.kind,  # pyright: ignore[reportArgumentType]
                target=critic.target,  # pyright: ignore[reportArgumentType]
                **critic.options,
                **critic.fit,
            ),
        )


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
        raise ConfigError(f"algo {config.algo}: must be {algo} or unset", "algo")
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
    used_by = f"{algo} (policy.update {update})"
    validation.check_unused(used_by, "policy", policy, options, UPDATES)
    validation.check_unused(f"{algo} (critic.kind {kind})", "critic", critic, shape, CRITICS)
    resolved = ResolvedConfig(
        **{name: getattr(config, name) for name in CommonConfig.__dataclass_fields__},
        env_version=config.env_version or spec.default_version,
        algo=algo,
        residual=config.residual or row.residual,
        physics=config.physics or spec.engines[0],
        policy=ResolvedPolicy(
            policy.hidden, policy.covariance, policy.initial_std, update, _filled(policy, options)
        ),
        critic=ResolvedCritic(
            critic.hidden,
            kind,
            critic.target or row.target,
            _filled(critic, shape),
            _filled(critic, SGD),
        ),
    )
    validation.check(resolved.as_config(), spec)
    return resolved


def _filled(settings: PolicyConfig | CriticConfig, defaults: Mapping[str, Any]) -> Options:
    def chosen(name: str, default: Any) -> Any:
        value = getattr(settings, name)
        return default if value is None else value

    return Options(tuple((name, chosen(name, default)) for name, default in defaults.items()))
