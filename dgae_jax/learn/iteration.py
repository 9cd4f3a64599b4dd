"""One training iteration as one pure function: roll out, estimate advantages, improve the policy, fit the critic."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env
from jaxtyping import Array, ArrayLike, Key

from dgae_jax.learn import normalizers
from dgae_jax.learn.diagnostics import Diagnose, nothing
from dgae_jax.learn.rollout import Act, Episodes, rollout, start
from dgae_jax.learn.types import Algorithm, Batch, Fit, TrainState, Transition
from dgae_jax.maths import gaussian
from dgae_jax.maths.returns import decay, lambda_return, lambda_sum
from dgae_jax.maths.statistics import explained_variance

Metrics = dict[str, Array]


def make_train(
    algorithm: Algorithm,
    env: Env,
    *,
    num_envs: int,
    horizon: int,
    episode_length: int,
    gamma: ArrayLike,
    lam: ArrayLike,
    normalize_observations: bool,
    normalize_rewards: bool,
    diagnose: Diagnose = nothing,
) -> tuple[Callable[[Array], TrainState], Callable[[TrainState], tuple[TrainState, Metrics]]]:
    """`init(key) -> state` and `train_step(state) -> (state, metrics)` (Algorithm policy_value_update).

    Both are pure; jit, scan and vmap them. One step consumes `num_envs * horizon` samples. γ and λ may be traced.
    """

    def init(key: Key[Array, ""]) -> TrainState:
        policy_key, critic_key, env_key, key = jax.random.split(key, 4)
        policy, critic = algorithm.policy.init(policy_key), algorithm.critic.init(critic_key)
        return TrainState(
            policy=Fit(policy, algorithm.policy_update.init(policy)),
            critic=Fit(critic, algorithm.critic_update.init(critic)),
            observations=normalizers.observations(int(env.observation_size)),  # pyright: ignore[reportArgumentType]
            returns=normalizers.return_scale(num_envs),
            episodes=start(env, env_key, num_envs),
            key=key,
            iteration=jnp.int32(0),
            failures=jnp.int32(0),
        )

    @jax.default_matmul_precision("highest")  # TF32 ruins training on GPUs that default to it
    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        act_key, target_key, policy_key, critic_key, key = jax.random.split(state.key, 5)
        episodes, step = rollout(env, _acting(algorithm, state), state.episodes, act_key, horizon=horizon, episode_length=episode_length)
        returns, reward = state.returns, step.reward
        if normalize_rewards:
            done = (step.terminated | step.truncated).astype(reward.dtype)
            returns, reward = normalizers.rescale(returns, reward, done, gamma)
        batch, estimates = _estimate(algorithm, state, step, reward, target_key, gamma, lam, diagnose)
        policy, improved = algorithm.policy_update.step(policy_key, state.policy, batch)
        critic, evaluated = algorithm.critic_update.step(critic_key, state.critic, batch)
        sound = _finite((policy, critic, improved["loss"], evaluated["loss"]))
        policy, critic = jax.tree.map(lambda new, old: jnp.where(sound, new, old), (policy, critic), (state.policy, state.critic))
        observations = normalizers.observe(state.observations, step.obs, step.sound) if normalize_observations else state.observations
        metrics = {
            **_account(episodes, step),
            "nonfinite": episodes.nonfinite - state.episodes.nonfinite,
            "skipped": 1.0 - sound,
            **{f"policy/{name}": value for name, value in improved.items()},
            **{f"critic/{name}": value for name, value in evaluated.items()},
            **estimates,
        }
        failures = jnp.where(sound, 0, state.failures + 1)
        return TrainState(policy, critic, observations, returns, episodes, key, state.iteration + 1, failures), metrics

    return init, train_step


def _finite(tree: Any) -> Array:
    """Whether every number is finite."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()


def _acting(algorithm: Algorithm, state: TrainState) -> Act:
    """The policy under the statistics of this iteration."""

    def act(key: Array, obs: Array) -> tuple[Array, Array]:
        distribution = algorithm.policy.apply(state.policy.params, normalizers.normalize(state.observations, obs))
        action = gaussian.sample(key, distribution)
        return action, gaussian.log_prob(distribution, action)

    return act


def _estimate(
    algorithm: Algorithm,
    state: TrainState,
    step: Transition,
    reward: Array,
    key: Array,
    gamma: ArrayLike,
    lam: ArrayLike,
    diagnose: Diagnose,
) -> tuple[Batch, Metrics]:
    """What the updates learn from: standardised advantages, and the critic's target, from the critic that acted."""
    obs, next_obs = (normalizers.normalize(state.observations, x) for x in (step.obs, step.next_obs))
    quantiles, next_quantiles = (algorithm.critic.predict(state.critic.params, x) for x in (obs, next_obs))
    discount, trace = decay(step.terminated, step.truncated, gamma=gamma, lam=lam)
    residual = algorithm.residual(reward, discount, quantiles, next_quantiles)
    advantage = lambda_sum(residual, discount * trace)
    target = algorithm.critic.target(key, reward, discount, trace, quantiles, next_quantiles)
    standard = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    standard = jnp.where(step.sound, standard, 0)
    batch = Batch(obs, step.action, step.log_prob, standard, target, reward, discount, next_obs, step.sound)
    value = quantiles.mean(-1)
    going = 1.0 - (step.terminated | step.truncated)
    metrics = {
        "critic/value": value.mean(),
        "critic/explained_variance": explained_variance(value, lambda_return(reward, discount, trace, quantiles, next_quantiles)),
        **diagnose(reward, discount, going, quantiles, next_quantiles),
    }
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch), metrics


def _account(episodes: Episodes, step: Transition) -> Metrics:
    """How the episodes went, in raw rewards."""
    return {
        "episode_return": jnp.nanmean(episodes.last_total),
        "episode_length": jnp.nanmean(episodes.last_steps),
        "episodes": (step.terminated | step.truncated).sum(),
        "reward": step.reward.mean(),
    }
