"""The configuration of a run as a user writes it: every number that decides the result.

A setting that is None is unset; `configs.resolved.resolve` fills it in.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Any, Literal, Self

from dgae_jax.configs.algorithms import ALGORITHMS, AlgorithmName
from dgae_jax.envs.registry import canonical_name

TargetName = Literal[
    "bellman", "bellman-frozen", "lambda-shift", "sr-lambda", "lambda-return", "monte-carlo"
]


class ConfigError(ValueError):
    """An invalid setting: its path (a command line shows its flag), value, and what is allowed."""

    def __init__(self, message: str, setting: str | None = None):
        super().__init__(message)
        self.setting = setting


def invalid(setting: str, value: Any, allowed: str) -> ConfigError:
    """Return the error that says what a setting must be."""
    shown = " ".join(map(str, value)) or "()" if isinstance(value, tuple) else value
    return ConfigError(f"{setting} {shown}: must be {allowed}", setting)


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the settings of plain data by their dotted paths."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        path = prefix + name
        out |= flat(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return out


class Settings:
    """Base of the dataclasses below: dotted access, and values in the form that compiles once."""

    def __post_init__(self):
        floats = floats_of(type(self))
        for name, value in vars(self).items():
            if name in floats and type(value) is int:
                object.__setattr__(self, name, float(value))
            if isinstance(value, list):
                object.__setattr__(self, name, tuple(value))

    def get(self, path: str) -> Any:
        """Return the setting at a dotted path, `policy.clip_eps` for one."""
        return attrgetter(path)(self)

    def replace(self, **settings: Any) -> Self:
        """Return a copy with some settings changed: `config.replace(**{"policy.clip_eps": 0.3})`.

        Raises:
            ConfigError: a setting does not exist.
        """
        config = self
        for path, value in settings.items():
            if not config.has(path):
                raise ConfigError(f"{path}: unknown setting", path)
            name, _, rest = path.partition(".")
            inner = getattr(config, name).replace(**{rest: value}) if rest else value
            config = dataclasses.replace(config, **{name: inner})  # pyright: ignore
        return config

    def has(self, path: str) -> bool:
        """Return whether there is a setting at a dotted path."""
        name, _, rest = path.partition(".")
        group = vars(self).get(name)
        return isinstance(group, Settings) and group.has(rest) if rest else name in vars(self)


def floats_of(cls: type) -> list[str]:
    """Return the names of the fields that are floats, also where they may be unset."""
    return [f.name for f in fields(cls) if f.type in (float, float | None)]


@dataclass(frozen=True)
class FitConfig(Settings):
    """A network and the gradient steps on it."""

    hidden: tuple[int, ...] = (64, 64)
    """Width of each hidden layer [units]."""
    optimizer: Literal["adam", "rmsprop"] | None = None
    """Optimizer."""
    learning_rate: float | None = None
    """Learning rate at the start [1]."""
    learning_rate_end: float | None = None
    """Learning rate at the end as a fraction of the start: 1 constant, 0 linear decay to zero.
    With a trust region it is max_kl that decays, during the last fifth of the run [1]."""
    epochs: int | None = None
    """Passes over each rollout [1]."""
    minibatches: int | None = None
    """Gradient steps per pass; must divide num_envs * num_steps [1]."""
    max_grad_norm: float | None = None
    """Largest global norm of a gradient [1]."""


@dataclass(frozen=True)
class PolicyConfig(FitConfig):
    """The policy network and its update."""

    update: Literal["clip", "gradient", "trust-region"] | None = None
    """clip (PPO), gradient (A2C) or trust-region (TRPO); unset: the algorithm's own."""
    covariance: Literal["shared", "state"] = "shared"
    """Standard deviation of actions: shared (one learned vector) or state (a network output)."""
    initial_std: float = 0.5
    """Standard deviation of the first actions [units of the action]."""
    clip_eps: float | None = None
    """PPO's clip range ε of the probability ratio [1]."""
    max_kl: float | None = None
    """Trust region: largest mean KL divergence of a step, summed over action dimensions [nats]."""
    damping: float | None = None
    """Trust region: multiple of the identity added to the Fisher matrix of that divergence [1]."""
    cg_iterations: int | None = None
    """Trust region: iterations of conjugate gradient [1]."""
    max_backtracks: int | None = None
    """Trust region: times a step is halved before it is given up [1]."""
    fisher_every: int | None = None
    """Trust region: the Fisher matrix is estimated from every n-th sample [samples]."""


@dataclass(frozen=True)
class CriticConfig(FitConfig):
    """The value network and its targets."""

    kind: Literal["scalar", "quantile", "sorted", "ordered"] | None = None
    """scalar (one value), quantile (a distribution), sorted (quantiles sorted after the network)
    or ordered (quantiles that cannot cross); unset: the algorithm's own."""
    target: TargetName | None = None
    """What the critic is fitted to: bellman, bellman-frozen, lambda-shift, sr-lambda, lambda-return
    or monte-carlo (algorithms.md#critic-targets); unset: the algorithm's own."""
    quantiles: int | None = None
    """Quantiles K of a distributional critic [1]."""
    kappa: float | None = None
    """Threshold κ of the quantile-Huber loss [units of the scaled return]."""


@dataclass(frozen=True)
class NoiseConfig(Settings):
    """Standard deviations of normal noise on the task, 0 for none; evaluations have none."""

    reward: float = 0.0
    """On the reward [units of the reward]."""
    action: float = 0.0
    """On the action, before it is clipped to the actuators' range [units of the action]."""
    observation: float = 0.0
    """On the observation [units of the observation]."""
    initial: float = 0.0
    """On positions and velocities at a reset, beside the task's own [m, rad, and per second]."""


@dataclass(frozen=True)
class CommonConfig(Settings):
    """The settings that every run uses."""

    env: str = "hopper"
    """Task: ant, hopper, swimmer, walker2d, or a third-party env: brax:NAME, playground:NAME
    (MuJoCo Playground) or gymnasium:ID (continuous actions, on a CPU)."""
    metric: str = "mean"
    """Risk measure over value distributions: mean (the paper's), cvar:ALPHA, wang:BETA, power:C or
    mean-cvar:ALPHA:WEIGHT."""
    seed: int = 0
    """Seed of the first run; the others follow by one [1]."""
    num_seeds: int = 1
    """Independent runs trained in one program [runs]."""
    total_steps: int = 1_000_000
    """Sample budget of each run, never exceeded [environment steps]."""
    num_envs: int = 16
    """Parallel envs [envs]."""
    num_steps: int = 128
    """Rollout length of each env per iteration [environment steps]."""
    episode_length: int = 1000
    """Time limit of an episode, a truncation [environment steps]."""
    gamma: float = 0.99
    """Discount factor γ, 0 to 1 [per environment step]."""
    gae_lambda: float = 0.95
    """λ of GAE and of the critic's λ-targets, 0 to 1 [1]."""
    normalize_observations: bool = True
    """Normalize observations by their running mean and standard deviation."""
    normalize_rewards: bool = True
    """Divide rewards by the running standard deviation of the discounted return."""
    diagnostics: bool = False
    """Log the calibration of the critic at every iteration."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)

    @property
    def samples_per_iteration(self) -> int:
        """Samples per iteration and run."""
        return self.num_envs * self.num_steps

    @property
    def iterations(self) -> int:
        """The largest whole number of iterations within the budget."""
        return self.total_steps // self.samples_per_iteration


@dataclass(frozen=True)
class Config(CommonConfig):
    """One training run, as a user writes it; `Hopper-v4` and `PPO` are understood too."""

    env_version: str | None = None
    """Gymnasium version of the task, v4 or v5; unset: v4, or none for a third-party env."""
    algo: AlgorithmName | None = None
    """Algorithm: ppo, trpo, a2c, or with a value distribution dppo, dtrpo, da2c; unset: dppo."""
    residual: Literal["td", "distributional"] | None = None
    """TD error of the advantage: td (of the means) or distributional (by the metric); unset: the
    algorithm's own."""
    physics: str | None = None
    """Engine: jax (MuJoCo's stages in our JAX code), mjx (MuJoCo MJX), mjx-warp (its Warp variant)
    or native (C MuJoCo, CPU); unset: jax, or mjx for brax:NAME and playground:NAME."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    critic: CriticConfig = field(default_factory=CriticConfig)

    def __post_init__(self):
        super().__post_init__()
        if not isinstance(self.env, str):
            return  # `resolve` says so
        env, version = canonical_name(self.env)
        if version and self.env_version not in (None, version):
            raise invalid("env_version", self.env_version, f"{version}, as in {self.env}, or unset")
        object.__setattr__(self, "env", env)
        object.__setattr__(self, "env_version", version or self.env_version)
        if isinstance(self.algo, str) and self.algo.lower() in ALGORITHMS:
            object.__setattr__(self, "algo", self.algo.lower())


def flag(setting: str) -> str:
    """Return the command-line flag of a setting."""
    return "--" + setting.replace("_", "-")
