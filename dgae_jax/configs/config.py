"""What a run is: every number that decides its result, with its unit and what is allowed.

The dataclasses are pytrees whose floats and sample budget are leaves: they may be traced, so a sweep over them is one
compiled program, and changing one does not compile again. Everything else is static.
"""

import dataclasses
from dataclasses import dataclass, field, fields
from typing import Any

import jax

from dgae_jax.configs.algorithms import TABLE


class ConfigError(ValueError):
    """A setting that cannot be; the message names the flag, the value and what is allowed."""


def _traced(*names: str):
    """Register a dataclass as a pytree whose leaves are the fields `names` and nested configurations."""

    def register(cls):
        rest = [f.name for f in fields(cls) if f.name not in names]
        return jax.tree_util.register_dataclass(cls, data_fields=list(names), meta_fields=rest)

    return register


@dataclass(frozen=True)
class FitConfig:
    """A network and the gradient steps on it."""

    hidden: tuple[int, ...] = (64, 64)
    """Width of each hidden layer [units]."""
    optimizer: str = "adam"
    """adam or rmsprop."""
    learning_rate: float = 3e-4
    """Learning rate at the start [1]."""
    learning_rate_end: float = 0.0
    """Learning rate at the end of the run as a fraction of its start: 1 constant, 0 linear decay to zero [1]."""
    epochs: int = 10
    """Passes over each rollout [1]."""
    minibatches: int = 32
    """Gradient steps per pass; must divide num_envs * horizon [1]."""
    max_grad_norm: float = 0.5
    """Largest global norm of a gradient [1]."""


_FIT = ("learning_rate", "learning_rate_end", "max_grad_norm")


@_traced(*_FIT, "clip", "initial_std", "radius", "damping")
@dataclass(frozen=True)
class PolicyConfig(FitConfig):
    """The policy network and how it improves."""

    update: str = "default"
    """clip (PPO), gradient (A2C) or trust-region (TRPO); default: the algorithm's own."""
    covariance: str = "shared"
    """Where the actions' deviation comes from: shared (one learned vector) or state (an output of the network)."""
    initial_std: float = 0.5
    """Deviation of the first actions [units of the action]."""
    clip: float = 0.2
    """PPO's clip range epsilon of the probability ratio [1]."""
    radius: float = 0.01
    """Trust region: largest mean KL divergence of a step [nats]."""
    damping: float = 0.1
    """Trust region: multiple of the identity added to the Fisher matrix [1]."""
    cg_iterations: int = 10
    """Trust region: iterations of conjugate gradient [1]."""
    backtracks: int = 10
    """Trust region: times a step is halved before it is given up [1]."""
    fisher_every: int = 1
    """Trust region: the Fisher matrix is taken over every n-th sample [samples]."""


@_traced(*_FIT, "kappa")
@dataclass(frozen=True)
class CriticConfig(FitConfig):
    """The value network and what it is fitted to."""

    kind: str = "default"
    """scalar (one value) or quantile (a distribution); default: the algorithm's own."""
    target: str = "default"
    """bellman, bellman-frozen, lambda-shift, sr-lambda or lambda-return; default: the algorithm's own."""
    quantiles: int = 64
    """Quantiles K of a distributional critic [1]."""
    kappa: float = 1.0
    """Threshold of the quantile-Huber loss of a distributional critic [units of the scaled return]."""


@dataclass(frozen=True)
class NoiseConfig:
    """Deviations of normal noise on the task, 0 for none; Gymnasium, the referee of evaluations, has none."""

    reward: float = 0.0
    """On the reward [units of the reward]."""
    action: float = 0.0
    """On the action, before it is clipped to the actuators' range [units of the action]."""
    observation: float = 0.0
    """On the observation [units of the observation]."""
    initial: float = 0.0
    """On positions and velocities at a reset, beside the task's own [m, rad, and per second]."""


@_traced("gamma", "lam", "total_steps", "policy", "critic")
@dataclass(frozen=True)
class Config:
    """One training run."""

    env: str = "hopper"
    """Task: ant, hopper, swimmer, walker2d, or brax:NAME for one of Brax's own."""
    env_version: str = "v4"
    """Gymnasium version whose semantics the task has: v4 (the same as Gym's v3) or v5."""
    algo: str = "dppo"
    """Algorithm: ppo, trpo, a2c, or with a value distribution dppo, dtrpo, da2c."""
    residual: str = "default"
    """One-step residual of the advantage: td (of means) or distributional (by the metric); default: the algorithm's own."""
    metric: str = "mean"
    """Preference over value distributions: mean (the paper's), cvar:α, wang:β, power:c or mean-cvar:α:weight."""
    physics: str = "jax"
    """Engine that simulates the task: jax (our own stages, CPU or GPU) or native (C MuJoCo, CPU)."""
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
    """Subtract the running mean of observations and divide by their deviation."""
    normalize_rewards: bool = True
    """Divide rewards by the running deviation of the discounted return."""
    diagnostics: bool = False
    """Calibration of the critic in the metrics of every iteration."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    critic: CriticConfig = field(default_factory=CriticConfig)

    @property
    def samples(self) -> int:
        """Samples per iteration and run."""
        return self.num_envs * self.horizon

    @property
    def iterations(self) -> int:
        """The largest whole number of iterations within the budget."""
        return self.total_steps // self.samples


def resolve(config: Config) -> Config:
    """The configuration with the algorithm's own parts written out."""
    row = TABLE[config.algo]

    def chosen(value: str, own: str) -> str:
        return own if value == "default" else value

    policy, critic = config.policy, config.critic
    return dataclasses.replace(
        config,
        residual=chosen(config.residual, row.residual),
        policy=dataclasses.replace(policy, update=chosen(policy.update, row.update)),
        critic=dataclasses.replace(critic, kind=chosen(critic.kind, row.critic), target=chosen(critic.target, row.target)),
    )


MAY_CHANGE = ("total_steps", "physics")
"""What of a configuration may change between the parts of one run."""


def flag(path: str) -> str:
    """The command-line spelling of a field."""
    return "--" + path.replace("_", "-")


def differences(one: Config, two: Config) -> dict[str, tuple[Any, Any]]:
    """The fields, by path, in which two configurations differ, with both values."""

    def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
        nested = (flat(v, f"{prefix}{k}.") if isinstance(v, dict) else {prefix + k: v} for k, v in values.items())
        return {path: value for each in nested for path, value in each.items()}

    ours, theirs = flat(to_dict(one)), flat(to_dict(two))
    return {path: (value, theirs[path]) for path, value in ours.items() if value != theirs[path]}


def to_dict(config: Config) -> dict[str, Any]:
    """Plain data for JSON."""
    return dataclasses.asdict(config)


def from_dict(data: dict[str, Any]) -> Config:
    """The configuration written by `to_dict`; raises `ConfigError` for missing or unknown names and wrong types."""
    return _from_dict(Config, data, "")


def _from_dict(cls, data: Any, prefix: str):
    if not isinstance(data, dict):
        raise ConfigError(f"{prefix or 'configuration'}: must be an object, not {data!r}")
    default = {f.name: getattr(cls(), f.name) for f in fields(cls)}
    for name in sorted(set(data) ^ set(default)):
        raise ConfigError(f"{prefix}{name}: {'unknown' if name in data else 'missing'}")
    return cls(**{name: _value(data[name], like, prefix + name) for name, like in default.items()})


def _value(value: Any, like: Any, path: str):
    if dataclasses.is_dataclass(like):
        return _from_dict(type(like), value, path + ".")
    if isinstance(like, tuple):
        ok = isinstance(value, list | tuple) and all(type(v) is int for v in value)
        value = tuple(value) if ok else value
    elif isinstance(like, float):
        ok = type(value) is float or (type(value) is int and abs(value) < 2**53)
        value = float(value) if ok else value
    else:
        ok = type(value) is type(like)
    if not ok:
        raise ConfigError(f"{path}: must be {type(like).__name__}, not {value!r}")
    return value
