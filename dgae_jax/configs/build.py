"""From a configuration to the things it names."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.envs.base import Env

from dgae_jax.configs.algorithms import TABLE
from dgae_jax.configs.config import Config, CriticConfig, PolicyConfig, resolve
from dgae_jax.envs.noise import Noisy
from dgae_jax.envs.registry import make_env, spec_of
from dgae_jax.learn import diagnostics, iteration
from dgae_jax.learn.critics import CRITICS, RESIDUALS
from dgae_jax.learn.networks import gaussian_policy
from dgae_jax.learn.normalizers import normalize
from dgae_jax.learn.types import Algorithm, Policy, TrainState
from dgae_jax.learn.updates import DESCENT, UPDATES, descend
from dgae_jax.maths.risk import weights_of


def make_task(config: Config) -> Env:
    """The environment a configuration names."""
    spec, noise = spec_of(config.env), dataclasses.asdict(config.noise)
    chosen = {"physics": config.physics, "version": config.env_version} if spec.versions else {}
    env = make_env(config.env, **chosen)
    return Noisy(env, **noise) if any(noise.values()) else env


def make_policy(env: Env, config: Config) -> Policy:
    """The policy network a configuration describes, sized for `env`."""
    settings = config.policy
    return gaussian_policy(
        _size(env), env.action_size, hidden=settings.hidden, covariance=settings.covariance, initial_std=settings.initial_std
    )


def make_algorithm(name: str, env: Env, config: Config) -> Algorithm:
    """The record of parts that `name` stands for, sized for `env`; parts that `config` names take the place of the row's.

    Raises ValueError, naming what exists, for an unknown name.
    """
    if name not in TABLE:
        raise ValueError(f"unknown algorithm {name!r}; choose from {', '.join(TABLE)}")
    config = resolve(dataclasses.replace(config, algo=name))
    policy, iterations, fit = make_policy(env, config), config.total_steps / config.samples, config.critic
    kind, improve = CRITICS[fit.kind], UPDATES[config.policy.update]
    critic = kind.build(_size(env), hidden=fit.hidden, target=fit.target, **_options(fit, kind.options))
    return Algorithm(
        policy=policy,
        critic=critic,
        residual=RESIDUALS[config.residual].build(weights_of(config.metric, fit.quantiles)),
        improve=improve.build(policy, iterations, **_options(config.policy, improve.options)),
        evaluate=descend(critic.loss, iterations, **_options(fit, DESCENT)),
    )


def _options(settings: PolicyConfig | CriticConfig, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(settings, name) for name in names}


def make_train(
    algorithm: Algorithm, env: Env, config: Config
) -> tuple[Callable[[jax.Array], TrainState], Callable[[TrainState], tuple[TrainState, iteration.Metrics]]]:
    """`init(key) -> state` and `train_step(state) -> (state, metrics)`: see `iteration.make_train`."""
    return iteration.make_train(
        algorithm,
        env,
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


class Trainer(NamedTuple):
    """The compiled programs of a run, over all its seeds at once; every leaf of the state has a leading seed axis."""

    init: Callable[[Config, jax.Array], TrainState]
    """`init(config, keys [S]) -> state`."""
    dispatch: Callable[[Config, TrainState, int], tuple[TrainState, iteration.Metrics]]
    """`dispatch(config, state, count) -> (state, metrics [capacity, S])`: `count <= capacity` iterations; rows from
    `count` on are zero. The state handed in is consumed."""


def make_trainer(env: Env, capacity: int) -> Trainer:
    """Compile once, run any number of iterations per call; the floats of the configuration may change between calls."""

    def parts(config: Config):
        return make_train(make_algorithm(config.algo, env, config), env, config)

    @jax.jit
    def init(config: Config, keys: jax.Array) -> TrainState:
        return _over_runs(parts(config)[0])(keys)

    @partial(jax.jit, donate_argnums=1)
    def dispatch(config: Config, state: TrainState, count: int):
        step = jax.jit(_over_runs(parts(config)[1]))  # jitted, so that asking for its shapes does not trace it twice
        rows = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), jax.eval_shape(step, state)[1])

        def iteration(i, carry):
            state, rows = carry
            state, row = step(state)
            return state, jax.tree.map(lambda all, one: all.at[i].set(one), rows, row)

        return jax.lax.fori_loop(0, count, iteration, (state, rows))

    return Trainer(init, dispatch)


def _over_runs(f: Callable) -> Callable:
    """`f` mapped over the leading axis of its argument.

    An axis of one is taken off and put back: XLA's CPU code for arrays with a leading 1 is several times slower.
    """

    def mapped(tree):
        if jax.tree.leaves(tree)[0].shape[0] > 1:
            return jax.vmap(f)(tree)
        return jax.tree.map(lambda x: jnp.expand_dims(x, 0), f(jax.tree.map(lambda x: x[0], tree)))

    return mapped


def seed_keys(config: Config) -> jax.Array:
    """One key per run: `key(seed)`, `key(seed + 1)`, …"""
    return jnp.stack([jax.random.key(config.seed + i) for i in range(config.num_seeds)])


def make_greedy(env: Env, config: Config) -> Callable[[TrainState, jax.Array], jax.Array]:
    """`greedy(state, obs [..., O]) -> action [..., A]`: the mean action of one trained run, within the actuators' range."""
    policy, (low, high) = make_policy(env, config), env.action_range

    def greedy(state: TrainState, obs: jax.Array) -> jax.Array:
        distribution = policy.apply(state.policy.params, normalize(state.observations, obs))
        return jnp.clip(distribution.mean, low, high)

    return greedy
