"""Tasks, networks, algorithms and training steps of a configuration; registration of parts."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from dgae_jax.configs import config as user
from dgae_jax.configs import parts, resolved
from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.configs.resolved import Options, ResolvedConfig, resolve
from dgae_jax.envs.base import Env
from dgae_jax.envs.custom import with_range
from dgae_jax.envs.noise import Noisy
from dgae_jax.envs.registry import make_env
from dgae_jax.learn import iteration, parallel
from dgae_jax.learn.critics import CRITICS, RESIDUALS, TARGETS
from dgae_jax.learn.iteration import InitFn, TrainStep
from dgae_jax.learn.networks import COVARIANCES, gaussian_policy
from dgae_jax.learn.normalizers import normalize
from dgae_jax.learn.types import Algorithm, InferenceState, Policy, TrainState
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


def make_policy(env: Env, config: ResolvedConfig) -> Policy:
    """Return the policy network of a configuration, sized for `env`."""
    policy = config.policy
    return gaussian_policy(
        _obs_size(env),
        env.action_size,
        hidden=policy.hidden,
        covariance=COVARIANCES[policy.covariance],
        initial_std=policy.initial_std,
    )


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
    network = CRITICS[critic.kind](
        _obs_size(env), hidden=critic.hidden, target=TARGETS[critic.target], **critic.options
    )
    weights = weights_of(config.metric, critic.outputs) if critic.is_distribution else None
    return Algorithm(
        policy=policy,
        critic=network,
        residual=RESIDUALS[config.residual](weights),
        policy_update=UPDATES[config.policy.update](policy, iterations, **config.policy.options),
        critic_update=minibatch_update(network.loss, iterations, **critic.fit),
    )


def make_train(
    algorithm: Algorithm, env: Env, config: Config | ResolvedConfig
) -> tuple[InitFn, TrainStep]:
    """Return `init(key) -> state` and `train_step(state) -> (state, metrics)`.

    Args:
        algorithm: made by `make_algorithm`, or a record of your own parts.
        env: the task; without an `action_range` its actions lie in [−1, 1].
        config: the run.

    Raises:
        ConfigError: the configuration is invalid.
    """
    return iteration.make_train(algorithm, with_range(env), resolve(config))


def make_trainer(env: Env, capacity: int, mesh: Mesh | None = None) -> parallel.Trainer:
    """Return the compiled programs of runs on `env`; see `parallel.make_trainer`."""

    def functions(config: ResolvedConfig) -> tuple[InitFn, TrainStep]:
        return make_train(make_algorithm(config.algo, env, config), env, config)

    return parallel.make_trainer(functions, capacity, mesh)


def seed_keys(config: ResolvedConfig) -> jax.Array:
    """Return one key per run: `key(seed)`, `key(seed + 1)`, …"""
    return jnp.stack([jax.random.key(config.seed + i) for i in range(config.num_seeds)])


def policies_of(state: TrainState) -> InferenceState:
    """Return the policies of a training state, with its leading axis of runs."""
    return InferenceState(state.policy.params, state.obs_stats)


def make_greedy(env: Env, config: ResolvedConfig) -> Infer:
    """Return `greedy(policy, obs [..., O]) -> action [..., A]`: the clipped mean action."""
    network, (low, high) = make_policy(env, config), env.action_range

    @jax.default_matmul_precision("highest")  # as in training
    def greedy(policy: InferenceState, obs: jax.Array) -> jax.Array:
        obs = normalize(policy.obs_stats, obs)
        return jnp.clip(network.apply(policy.params, obs).mean, low, high)

    return greedy


def make_quantiles(env: Env, config: ResolvedConfig) -> Infer:
    """Return `quantiles(critic, obs [..., O]) -> [..., K]` of the scaled return."""
    network = make_algorithm(config.algo, env, config).critic

    @jax.default_matmul_precision("highest")
    def quantiles(critic: InferenceState, obs: jax.Array) -> jax.Array:
        return network.predict(critic.params, normalize(critic.obs_stats, obs))

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
