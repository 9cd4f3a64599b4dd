"""One training iteration as a pure function: rollout, advantages, policy update, critic update."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from dgae_jax.configs.config import Config
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.envs.base import Env
from dgae_jax.envs.custom import with_range
from dgae_jax.learn import devices, diagnostics, normalizers
from dgae_jax.learn.rollout import Act, Episodes, rollout, start
from dgae_jax.learn.types import (
    Algorithm,
    Batch,
    InferenceState,
    Metrics,
    Network,
    TrainableState,
    TrainState,
    Transition,
)
from dgae_jax.maths import gaussian
from dgae_jax.maths.returns import decay, lambda_return, lambda_sum
from dgae_jax.maths.statistics import explained_variance

InitFn = Callable[[Array], TrainState]
"""`init(key) -> state`."""
TrainStep = Callable[[TrainState], tuple[TrainState, Metrics]]
"""`train_step(state) -> (state, metrics)`."""


def make_train(
    algorithm: Algorithm, env: Env, config: Config | ResolvedConfig
) -> tuple[InitFn, TrainStep]:
    """Return the pure functions of a run (Algorithm policy_value_update); jit, scan and vmap them.

    Args:
        algorithm: made by `make_algorithm`, or a record of your own parts.
        env: the task; without an `action_range` its actions lie in [−1, 1].
        config: the run; γ and λ may be traced.

    Returns:
        `init(key) -> state` and `train_step(state) -> (state, metrics)`; a step consumes
        `num_envs * num_steps` samples.

    Raises:
        ConfigError: the configuration is invalid.
    """
    env, config = with_range(env), resolve(config)
    num_envs, gamma = config.num_envs, config.gamma
    obs_size = int(env.observation_size)  # pyright: ignore[reportArgumentType]

    def init(key: Key[Array, ""]) -> TrainState:
        policy_key, critic_key, env_key, key = jax.random.split(key, 4)
        policy, critic = algorithm.policy.init(policy_key), algorithm.critic.init(critic_key)
        normalized = config.normalize_observations
        return TrainState(
            policy=TrainableState(policy, algorithm.policy_update.init(policy)),
            critic=TrainableState(critic, algorithm.critic_update.init(critic)),
            obs_stats=normalizers.init_obs_stats(obs_size) if normalized else None,
            reward_scale=normalizers.init_reward_scale(num_envs),
            episodes=devices.divide(start(env, jax.random.split(env_key, num_envs))),
            key=key,
            iteration=jnp.int32(0),
            failures=jnp.int32(0),
        )

    @jax.default_matmul_precision("highest")  # TF32 ruins training on GPUs that default to it
    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        act_key, target_key, policy_key, critic_key, key = jax.random.split(state.key, 5)
        keys = jax.random.split(act_key, (config.num_steps, num_envs))
        episodes, step = _roll_out(env, algorithm, state, keys, config.episode_length)
        reward_scale, reward, obs_stats = state.reward_scale, step.reward, state.obs_stats
        if config.normalize_rewards:
            done = (step.terminated | step.truncated).astype(reward.dtype)
            scaled = normalizers.scale_rewards(reward_scale, reward, done, step.mask, gamma)
            reward_scale, reward = scaled
        batch, estimates = _estimate(algorithm, state, step, reward, target_key, config)
        (new_policy, policy_info), (new_critic, critic_info) = devices.concurrently(
            (algorithm.policy_update.step, (policy_key, state.policy, batch)),
            (algorithm.critic_update.step, (critic_key, state.critic, batch)),
        )
        policy, policy_finite = _skip_nonfinite(new_policy, policy_info, state.policy)
        critic, critic_finite = _skip_nonfinite(new_critic, critic_info, state.critic)
        if config.normalize_observations:
            obs_stats = normalizers.update_obs_stats(obs_stats, step.obs, step.mask)
        updated = policy_finite & critic_finite
        failures = jnp.where(updated & (step.mask.mean() >= 0.5), 0, state.failures + 1)
        metrics = {
            "episode_return": jnp.nanmean(episodes.last_total),  # in rewards that are not scaled
            "episode_length": jnp.nanmean(episodes.last_steps),
            "episodes": (step.terminated | step.truncated).sum(),
            "reward": step.reward.mean(),
            "nonfinite": (episodes.nonfinite - state.episodes.nonfinite).sum(),
            "skipped": 1.0 - updated,
            **{f"policy/{name}": value for name, value in policy_info.items()},
            **{f"critic/{name}": value for name, value in critic_info.items()},
            **estimates,
        }
        iteration = state.iteration + 1
        after = policy, critic, obs_stats, reward_scale, episodes, key, iteration, failures
        return TrainState(*after), metrics

    return init, train_step


def _skip_nonfinite(
    new: TrainableState, info: Metrics, old: TrainableState
) -> tuple[TrainableState, Bool[Array, ""]]:
    """Keep the old network if the update is not finite; policy and critic are independent."""
    finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves((new, info["loss"]))]).all()
    return jax.tree.map(lambda n, o: jnp.where(finite, n, o), new, old), finite


def _roll_out(
    env: Env, algorithm: Algorithm, state: TrainState, keys: Key[Array, "T N"], episode_length: int
) -> tuple[Episodes, Transition]:
    """Roll out the envs of each device on that device, and gather the data on all."""

    def own_envs(actor: InferenceState, episodes: Episodes, keys: Key[Array, "T n"]):
        act = sampler(algorithm.policy, actor)
        return rollout(env, act, episodes, keys, episode_length=episode_length)

    actor = InferenceState(state.policy.params, state.obs_stats)
    per_device = devices.divided(own_envs, (None, 0, 1), (0, 1))
    episodes, step = per_device(actor, state.episodes, keys)
    return episodes, devices.divide(step, axis=None)


def sampler(policy: Network, actor: InferenceState) -> Act:
    """Return the function that samples actions and their log-probabilities."""

    def act(keys: Array, obs: Array) -> tuple[Array, Array]:
        distribution = policy.apply(actor.params, normalizers.normalize(actor.obs_stats, obs))
        action = jax.vmap(gaussian.sample)(keys, distribution)
        return action, gaussian.log_prob(distribution, action)

    return act


def _estimate(
    algorithm: Algorithm,
    state: TrainState,
    step: Transition,
    reward: Array,
    key: Array,
    config: ResolvedConfig,
) -> tuple[Batch, Metrics]:
    """Compute standardized advantages and critic targets from the critic at rollout time."""
    gamma, critic = config.gamma, algorithm.critic
    obs, next_obs = (normalizers.normalize(state.obs_stats, x) for x in (step.obs, step.next_obs))
    quantiles, next_quantiles = (critic.predict(state.critic.params, x) for x in (obs, next_obs))
    ends = step.terminated, step.truncated
    discount, trace = decay(*ends, gamma=gamma, lam=config.gae_lambda)
    delta = algorithm.residual(reward, discount, quantiles, next_quantiles)
    advantage = lambda_sum(delta, discount * trace)
    target_lam = config.gae_lambda if critic.lam is None else critic.lam
    _, target_trace = decay(*ends, gamma=gamma, lam=target_lam)
    target = critic.target(key, reward, discount, target_trace, quantiles, next_quantiles)
    mean, std = advantage.mean(where=step.mask), advantage.std(where=step.mask)
    advantage = jnp.where(step.mask, (advantage - mean) / (std + 1e-8), 0)
    value = quantiles.mean(-1)
    batch = Batch(
        obs=obs,
        action=step.action,
        log_prob=step.log_prob,
        advantage=advantage,
        value=value,
        target=target,
        reward=reward,
        discount=discount,
        next_obs=next_obs,
        mask=step.mask,
    )
    returns = lambda_return(reward, discount, trace, quantiles, next_quantiles)
    metrics = {
        "critic/value": value.mean(),
        "critic/explained_variance": explained_variance(value, returns),
    }
    if config.diagnostics:
        predictions = quantiles, next_quantiles
        continues = 1.0 - (step.terminated | step.truncated)
        metrics |= diagnostics.critic_diagnostics(reward, discount, continues, *predictions)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch), metrics
