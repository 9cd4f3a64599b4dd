"""What a run is: every number that decides its result, with its unit and what is allowed.

A setting that is None is unset: `resolve` fills in what the algorithm and the task take, and settings that the run's parts do not
use stay None. Nothing here imports JAX, so that a command line is checked before it is loaded; `configs.pytree` makes the
dataclasses pytrees.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from dgae_jax.configs.algorithms import TABLE
from dgae_jax.configs.parts import CRITICS, DESCENT, UPDATES
from dgae_jax.envs.registry import EnvSpec, spec_of


class ConfigError(ValueError):
    """An invalid setting; the message names the setting, the value and what is allowed.

    `setting` is the path of the setting that the message begins with, where there is one; a command line writes it as its flag.
    """

    def __init__(self, message: str, setting: str | None = None):
        super().__init__(message)
        self.setting = setting


def invalid(setting: str, value: Any, allowed: str) -> ConfigError:
    """The error that says what a setting must be."""
    shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
    return ConfigError(f"{setting} {shown}: must be {allowed}", setting)


class _Settings:
    """Values in the form that compiles once: whole numbers given for floats become floats, and lists tuples."""

    def __post_init__(self):
        floats = floats_of(type(self))
        for f in fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, f.name)
            if f.name in floats and type(value) is int:
                object.__setattr__(self, f.name, float(value))
            if isinstance(value, list):
                object.__setattr__(self, f.name, tuple(value))


def floats_of(cls: type) -> list[str]:
    """The fields that are floats, also where they may be unset."""
    return [f.name for f in fields(cls) if f.type in (float, float | None)]


@dataclass(frozen=True)
class FitConfig(_Settings):
    """A network and the gradient steps on it."""

    hidden: tuple[int, ...] = (64, 64)
    """Width of each hidden layer [units]."""
    optimizer: str | None = None
    """adam or rmsprop."""
    learning_rate: float | None = None
    """Learning rate at the start [1]."""
    learning_rate_end: float | None = None
    """Learning rate at the end of the run as a fraction of its start: 1 constant, 0 linear decay to zero; a trust region's radius
    decays in the last fifth of the run [1]."""
    epochs: int | None = None
    """Passes over each rollout [1]."""
    minibatches: int | None = None
    """Gradient steps per pass; must divide num_envs * horizon [1]."""
    max_grad_norm: float | None = None
    """Largest global norm of a gradient [1]."""


@dataclass(frozen=True)
class PolicyConfig(FitConfig):
    """The policy network and how it improves."""

    update: str | None = None
    """clip (PPO), gradient (A2C) or trust-region (TRPO); unset: the algorithm's own."""
    covariance: str = "shared"
    """Where the actions' standard deviation comes from: shared (one learned vector) or state (an output of the network)."""
    initial_std: float = 0.5
    """Standard deviation of the first actions [units of the action]."""
    clip: float | None = None
    """PPO's clip range epsilon of the probability ratio [1]."""
    radius: float | None = None
    """Trust region: largest mean KL divergence of a step, summed over the action's dimensions [nats]."""
    damping: float | None = None
    """Trust region: multiple of the identity added to the Fisher matrix of the summed KL divergence [1]."""
    cg_iterations: int | None = None
    """Trust region: iterations of conjugate gradient [1]."""
    backtracks: int | None = None
    """Trust region: times a step is halved before it is given up [1]."""
    fisher_every: int | None = None
    """Trust region: the Fisher matrix is taken over every n-th sample [samples]."""


@dataclass(frozen=True)
class CriticConfig(FitConfig):
    """The value network and what it is fitted to."""

    kind: str | None = None
    """scalar (one value), quantile (a distribution), sorted (the same without crossings) or ordered (another without); unset: the
    algorithm's own."""
    target: str | None = None
    """bellman, bellman-frozen, lambda-shift, sr-lambda, lambda-return or monte-carlo; unset: the algorithm's own."""
    quantiles: int | None = None
    """Quantiles K of a distributional critic [1]."""
    kappa: float | None = None
    """Threshold of the quantile-Huber loss of a distributional critic [units of the scaled return]."""


@dataclass(frozen=True)
class NoiseConfig(_Settings):
    """Standard deviations of normal noise on the task, 0 for none; Gymnasium, the referee of evaluations, has none."""

    reward: float = 0.0
    """On the reward [units of the reward]."""
    action: float = 0.0
    """On the action, before it is clipped to the actuators' range [units of the action]."""
    observation: float = 0.0
    """On the observation [units of the observation]."""
    initial: float = 0.0
    """On positions and velocities at a reset, beside the task's own [m, rad, and per second]."""


@dataclass(frozen=True)
class Config(_Settings):
    """One training run."""

    env: str = "hopper"
    """Task: ant, hopper, swimmer, walker2d, or one of somebody else's: brax:NAME, playground:NAME (MuJoCo Playground) or gymnasium:ID
    (continuous, on a CPU)."""
    env_version: str | None = None
    """Gymnasium version whose semantics the task has: v4 (Gym's v3, but for Ant's contact forces and their cost) or v5; unset: v4, or
    none for a task of somebody else's."""
    algo: str | None = None
    """Algorithm: ppo, trpo, a2c, or with a value distribution dppo, dtrpo, da2c; unset: dppo."""
    residual: str | None = None
    """One-step residual of the advantage: td (of means) or distributional (by the metric); unset: the algorithm's own."""
    metric: str = "mean"
    """Preference over value distributions: mean (the paper's), cvar:ALPHA, wang:BETA, power:C or mean-cvar:ALPHA:WEIGHT."""
    physics: str | None = None
    """Engine that simulates the task: jax (our own stages, CPU or GPU), mjx (MuJoCo MJX), mjx-warp (its Warp variant) or native
    (C MuJoCo, CPU); unset: jax, or mjx for brax:NAME and playground:NAME; gymnasium:ID has gymnasium only."""
    seed: int = 0
    """Seed of the first run; the others follow by one [1]."""
    num_seeds: int = 1
    """Independent runs trained side by side in one program [runs]."""
    total_steps: int = 1_000_000
    """Sample budget of each run, never exceeded [environment steps]."""
    num_envs: int = 16
    """Worlds simulated in parallel [worlds]."""
    horizon: int = 128
    """Rollout length of each world per iteration [environment steps]."""
    episode_length: int = 1000
    """Time limit of an episode, a truncation [environment steps]."""
    gamma: float = 0.99
    """Discount factor, 0 to 1 [per environment step]."""
    lam: float = 0.95
    """Lambda of GAE and of the critic's lambda targets, 0 to 1 [1]."""
    normalize_observations: bool = True
    """Subtract the running mean of observations and divide by their standard deviation."""
    normalize_rewards: bool = True
    """Divide rewards by the running standard deviation of the discounted return."""
    diagnostics: bool = False
    """Calibration of the critic in the metrics of every iteration."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    critic: CriticConfig = field(default_factory=CriticConfig)

    @property
    def task(self) -> str:
        """The task with its version, where it has one."""
        return f"{self.env}-{self.env_version}" if self.env_version else self.env

    @property
    def samples_per_iteration(self) -> int:
        """Samples per iteration and run."""
        return self.num_envs * self.horizon

    @property
    def iterations(self) -> int:
        """The largest whole number of iterations within the budget."""
        return self.total_steps // self.samples_per_iteration


def resolve(config: Config) -> Config:
    """The configuration with everything unset that the run uses written out.

    Raises ConfigError for an unknown name of a task, an algorithm or a part.
    """
    spec, config = task_spec(config), _fill(config, {"algo": "dppo"})
    row = lookup("algo", config.algo, TABLE)
    config = _fill(config, {"physics": spec.default_engine, "env_version": spec.default_version, "residual": row.residual})
    policy, critic = _fill(config.policy, {"update": row.policy_update}), _fill(config.critic, {"kind": row.critic, "target": row.target})
    policy = _fill(policy, lookup("policy.update", policy.update, UPDATES).options)
    critic = _fill(critic, {**DESCENT, **lookup("critic.kind", critic.kind, CRITICS).options})
    return dataclasses.replace(config, policy=policy, critic=critic)


def _fill(settings: Any, defaults: Mapping[str, Any]) -> Any:
    return dataclasses.replace(settings, **{name: value for name, value in defaults.items() if getattr(settings, name) is None})


def lookup(setting: str, name: Any, table: Mapping[str, Any]) -> Any:
    """The entry of a table; raises ConfigError, naming what exists, for a name that is not in it."""
    if not isinstance(name, str) or name not in table:
        raise invalid(setting, name, f"one of {', '.join(table)}")
    return table[name]


def task_spec(config: Config, setting: str = "env") -> EnvSpec:
    """What exists of the configuration's task; raises ConfigError, naming the tasks, for an unknown one, given as `setting`."""
    try:
        return spec_of(config.env)
    except ValueError as allowed:
        raise invalid(setting, config.env, str(allowed)) from None


def flag(setting: str) -> str:
    """The command-line spelling of a setting."""
    return "--" + setting.replace("_", "-")
