"""Tasks, networks and algorithms of a configuration; registration of parts."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dgae_jax.configs import config as user
from dgae_jax.configs import parts, resolved
from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.configs.resolved import Options, ResolvedConfig, resolve
from dgae_jax.envs.base import Env
from dgae_jax.envs.noise import Noisy
from dgae_jax.envs.registry import make_env
from dgae_jax.learn.critics import CRITICS, RESIDUALS, TARGETS
from dgae_jax.learn.networks import COVARIANCES, network
from dgae_jax.learn.normalizers import normalize
from dgae_jax.learn.types import Algorithm, InferenceState, Network, TrainState
from dgae_jax.learn.updates import OPTIMIZERS, UPDATES, minibatch_update
from dgae_jax.maths.risk import weights_of

Infer = Callable[[InferenceState, jax.Array], jax.Array]

TABLES: dict[str, tuple[dict[str, parts.Defaults], dict[str, Any]]] = {
    "update": (parts.UPDATES, UPDATES),
    "critic": (parts.CRITICS, CRITICS),
    "target": (parts.TARGETS, TARGETS),
    "residual": (parts.RESIDUALS, RESIDUALS),
    "covariance": (parts.COVARIANCES, COVARIANCES),
    "optimizer": (parts.OPTIMIZERS, OPTIMIZERS),
}
"""By kind of part: the names with their settings, and the functions."""


def register(kind: str, name: str, part: Any, settings: parts.Defaults | None = None) -> None:
    """Add a part of your own, to be named in a configuration.

    Args:
        kind: `update`, `critic`, `target`, `residual`, `covariance` or `optimizer`.
        name: what the configuration calls it.
        part: the function, or the `Target`; see the tables in `learn`.
        settings: fields of `PolicyConfig` or `CriticConfig` that it takes, with their defaults.
    """
    names, functions = TABLES[kind]
    names[name], functions[name] = settings or {}, part


def make_task(config: ResolvedConfig) -> Env:
    """Return the env of a configuration with its noise; raise ConfigError if it cannot be built."""
    try:
        env = make_env(config.env, physics=config.physics, version=config.env_version)
    except (ValueError, TypeError) as reason:
        allowed = f"a task that can be built on {config.physics} ({reason})"
        raise ConfigError(f"env {config.env}: must be {allowed}", "env") from reason
    noise = dataclasses.asdict(config.noise)
    return Noisy(env, **noise) if any(noise.values()) else env


def make_policy(env: Env, config: ResolvedConfig) -> Network:
    """Return the policy network of a configuration, sized for `env`."""
    policy = config.policy
    covariance = COVARIANCES[policy.covariance]
    return network(covariance(policy.hidden, env.action_size, policy.initial_std), _obs_size(env))


def make_algorithm(name: str, env: Env, config: Config | ResolvedConfig) -> Algorithm:
    """Return the algorithm `name` sized for `env`, with the parts that `config` names.

    Args:
        name: a key of `configs.algorithms.ALGORITHMS`.
        env: the task.
        config: the run.

    Raises:
        ConfigError: an unknown name, an invalid configuration, or one of another algorithm.
    """
    config = resolve(config, name)
    policy, critic = make_policy(env, config), config.critic
    iterations = config.total_steps / config.samples_per_iteration
    target = TARGETS[critic.target]
    values = CRITICS[critic.kind](
        _obs_size(env), hidden=critic.hidden, target=target, **critic.options
    )
    weights = weights_of(config.metric, critic.outputs) if critic.is_distribution else None
    return Algorithm(
        policy=policy,
        critic=values,
        residual=RESIDUALS[config.residual](weights),
        policy_update=UPDATES[config.policy.update](policy, iterations, **config.policy.options),
        critic_update=minibatch_update(values.loss, iterations, **critic.fit),
    )


def seed_keys(config: ResolvedConfig) -> jax.Array:
    """Return one key per run: `key(seed)`, `key(seed + 1)`, …"""
    return jnp.stack([jax.random.key(config.seed + i) for i in range(config.num_seeds)])


def policies_of(state: TrainState) -> InferenceState:
    """Return the policies of a training state, with its leading axis of runs."""
    return InferenceState(state.policy.params, state.obs_stats)


def make_greedy(env: Env, config: ResolvedConfig) -> Infer:
    """Return `greedy(policy, obs [..., O]) -> action [..., A]`: the clipped mean action."""
    policy_network, (low, high) = make_policy(env, config), env.action_range

    @jax.default_matmul_precision("highest")  # as in training
    def greedy(policy: InferenceState, obs: jax.Array) -> jax.Array:
        obs = normalize(policy.obs_stats, obs)
        return jnp.clip(policy_network.apply(policy.params, obs).mean, low, high)

    return greedy


def make_quantiles(env: Env, config: ResolvedConfig) -> Infer:
    """Return `quantiles(critic, obs [..., O]) -> [..., K]` of the scaled return."""
    predict = make_algorithm(config.algo, env, config).critic.predict

    @jax.default_matmul_precision("highest")
    def quantiles(critic: InferenceState, obs: jax.Array) -> jax.Array:
        return predict(critic.params, normalize(critic.obs_stats, obs))

    return quantiles


def _obs_size(env: Env) -> int:
    return int(env.observation_size)  # pyright: ignore[reportArgumentType]


def _register_pytrees() -> None:
    """Make floats and the budget leaves, which may be traced; everything else is static."""
    nested = ("policy", "critic", "options", "fit")
    plain = user.PolicyConfig, user.CriticConfig, Config
    complete = resolved.ResolvedPolicy, resolved.ResolvedCritic, ResolvedConfig
    for cls in plain + complete:
        names = [f.name for f in dataclasses.fields(cls)]
        leaves = {*user.floats_of(cls), "total_steps", *nested}.intersection(names)
        jax.tree_util.register_dataclass(
            cls, data_fields=sorted(leaves), meta_fields=[n for n in names if n not in leaves]
        )

    def flatten(options: Options):
        static = {name: x for name, x in options.items() if isinstance(x, int | str | tuple)}
        return [{name: x for name, x in options.items() if name not in static}], Options(static)

    def unflatten(static: Options, floats):
        return Options({**static, **floats[0]})

    jax.tree_util.register_pytree_node(Options, flatten, unflatten)


_register_pytrees()
