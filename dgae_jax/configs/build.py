"""From a configuration to the things it names."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

import dgae_jax.configs.pytree  # noqa: F401
from dgae_jax.configs.config import Config, ConfigError, CriticConfig, PolicyConfig, lookup
from dgae_jax.configs.parts import COVARIANCES, CRITICS, DESCENT, OPTIMIZERS, RESIDUALS, TARGETS, UPDATES
from dgae_jax.configs.validation import validate
from dgae_jax.envs.base import Env
from dgae_jax.envs.given import with_range
from dgae_jax.envs.noise import Noisy
from dgae_jax.envs.registry import make_env
from dgae_jax.learn import diagnostics, iteration, parallel
from dgae_jax.learn.networks import gaussian_policy
from dgae_jax.learn.normalizers import normalize
from dgae_jax.learn.types import Algorithm, Fitted, Policy, TrainState
from dgae_jax.learn.updates import descend
from dgae_jax.maths.risk import weights_of


def make_task(config: Config) -> Env:
    """The environment a configuration names; raises ConfigError if it cannot be built."""
    config = validate(config)
    try:
        env = make_env(config.env, physics=config.physics, version=config.env_version)
    except (ValueError, TypeError) as reason:
        raise ConfigError(f"env {config.env}: must be a task that can be built on {config.physics} ({reason})", "env") from reason
    noise = dataclasses.asdict(config.noise)
    return Noisy(env, **noise) if any(noise.values()) else env


def make_policy(env: Env, config: Config) -> Policy:
    """The policy network a configuration describes, sized for `env`."""
    settings = config.policy
    covariance = lookup("policy.covariance", settings.covariance, COVARIANCES).build
    return gaussian_policy(_size(env), env.action_size, hidden=settings.hidden, covariance=covariance, initial_std=settings.initial_std)


def make_algorithm(name: str, env: Env, config: Config) -> Algorithm:
    """The record of parts that `name` stands for, sized for `env`; parts that `config` names take the place of the row's.

    Raises ConfigError for an unknown name, an invalid configuration, and one that names another algorithm.
    """
    if config.algo not in (None, name):
        raise ConfigError(f"algo {config.algo}: must be {name}, as in make_algorithm, or left out", "algo")
    config = validate(dataclasses.replace(config, algo=name))
    policy, iterations, fit = make_policy(env, config), config.total_steps / config.samples_per_iteration, config.critic
    kind, improve = lookup("critic.kind", fit.kind, CRITICS), lookup("policy.update", config.policy.update, UPDATES)
    critic = kind.build(
        _size(env), hidden=fit.hidden, target=lookup("critic.target", fit.target, TARGETS).build, **_options(fit, kind.options)
    )
    weights = weights_of(config.metric, fit.quantiles) if fit.quantiles else None
    return Algorithm(
        policy=policy,
        critic=critic,
        residual=lookup("residual", config.residual, RESIDUALS).build(weights),
        policy_update=improve.build(policy, iterations, **_options(config.policy, improve.options)),
        critic_update=descend(critic.loss, iterations, **_options(fit, DESCENT)),
    )


def _options(settings: PolicyConfig | CriticConfig, names: Any) -> dict[str, Any]:
    options = {name: getattr(settings, name) for name in names}
    return options | {"optimizer": OPTIMIZERS[options["optimizer"]].build} if "optimizer" in options else options


def make_train(
    algorithm: Algorithm, env: Env, config: Config
) -> tuple[Callable[[jax.Array], TrainState], Callable[[TrainState], tuple[TrainState, iteration.Metrics]]]:
    """`init(key) -> state` and `train_step(state) -> (state, metrics)`: see `iteration.make_train`.

    Actions of an environment without an `action_range` lie in [−1, 1]. Raises ConfigError for an invalid configuration.
    """
    config = validate(config)
    return iteration.make_train(
        algorithm,
        with_range(env),
        num_envs=config.num_envs,
        horizon=config.horizon,
        episode_length=config.episode_length,
        gamma=config.gamma,
        lam=config.lam,
        normalize_observations=config.normalize_observations,
        normalize_rewards=config.normalize_rewards,
        diagnose=diagnostics.of_critic if config.diagnostics else diagnostics.nothing,
    )


def _size(env: Env) -> int:
    return int(env.observation_size)  # pyright: ignore[reportArgumentType]


def make_trainer(env: Env, capacity: int, mesh: Mesh | None = None) -> parallel.Trainer:
    """The compiled programs of runs on `env`, for `init(config, keys)` and up to `capacity` iterations per dispatch.

    The devices of `mesh` (`learn.devices.make_mesh`) share the work; by default there is one.
    """

    def parts(config: Config):
        config = validate(config)
        return make_train(make_algorithm(str(config.algo), env, config), env, config)

    return parallel.make_trainer(parts, capacity, mesh)


def seed_keys(config: Config) -> jax.Array:
    """One key per run: `key(seed)`, `key(seed + 1)`, …"""
    return jnp.stack([jax.random.key(config.seed + i) for i in range(config.num_seeds)])


def policies_of(state: TrainState) -> Fitted:
    """The policies of a training state; leaves keep its leading axis of runs."""
    return Fitted(state.policy.params, state.observations)


def make_greedy(env: Env, config: Config) -> Callable[[Fitted, jax.Array], jax.Array]:
    """`greedy(policy, obs [..., O]) -> action [..., A]`: the mean action of one run's policy, within the actuators' range."""
    network, (low, high) = make_policy(env, config), env.action_range

    @jax.default_matmul_precision("highest")  # as in training
    def greedy(policy: Fitted, obs: jax.Array) -> jax.Array:
        return jnp.clip(network.apply(policy.params, normalize(policy.observations, obs)).mean, low, high)

    return greedy


def make_quantiles(env: Env, config: Config) -> Callable[[Fitted, jax.Array], jax.Array]:
    """`quantiles(critic, obs [..., O]) -> [..., K]`: the value distribution of one run's critic, of scaled returns."""
    network = make_algorithm(str(config.algo), env, config).critic

    @jax.default_matmul_precision("highest")
    def quantiles(critic: Fitted, obs: jax.Array) -> jax.Array:
        return network.predict(critic.params, normalize(critic.observations, obs))

    return quantiles
