"""One training iteration as one pure function: roll out, estimate advantages, improve the policy, fit the critic."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Key

from dgae_jax.envs.base import Env
from dgae_jax.learn import devices, normalizers
from dgae_jax.learn.diagnostics import Diagnose, nothing
from dgae_jax.learn.rollout import Act, Episodes, rollout, start
from dgae_jax.learn.types import Algorithm, Batch, Fit, Fitted, Policy, TrainState, Transition
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
    obs_size = int(env.observation_size)  # pyright: ignore[reportArgumentType]

    def init(key: Key[Array, ""]) -> TrainState:
        policy_key, critic_key, env_key, key = jax.random.split(key, 4)
        policy, critic = algorithm.policy.init(policy_key), algorithm.critic.init(critic_key)
        return TrainState(
            policy=Fit(policy, algorithm.policy_update.init(policy)),
            critic=Fit(critic, algorithm.critic_update.init(critic)),
            observations=normalizers.observations(obs_size) if normalize_observations else None,
            reward_scale=normalizers.reward_scale(num_envs),
            episodes=devices.divide(start(env, jax.random.split(env_key, num_envs))),
            key=key,
            iteration=jnp.int32(0),
            failures=jnp.int32(0),
        )

    @jax.default_matmul_precision("highest")  # TF32 ruins training on GPUs that default to it
    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        act_key, target_key, policy_key, critic_key, key = jax.random.split(state.key, 5)
        keys = jax.random.split(act_key, (horizon, num_envs))
        episodes, step = _roll_out(env, algorithm, state, keys, episode_length)
        reward_scale, reward, observations = state.reward_scale, step.reward, state.observations
        if normalize_rewards:
            done = (step.terminated | step.truncated).astype(reward.dtype)
            reward_scale, reward = normalizers.rescale(reward_scale, reward, done, step.valid, gamma)
        batch, estimates = _estimate(algorithm, state, step, reward, target_key, gamma, lam, diagnose)
        (new_policy, policy_info), (new_critic, critic_info) = devices.side_by_side(
            (algorithm.policy_update.step, (policy_key, state.policy, batch)),
            (algorithm.critic_update.step, (critic_key, state.critic, batch)),
        )
        policy, policy_finite = _kept_if_finite(new_policy, policy_info, state.policy)
        critic, critic_finite = _kept_if_finite(new_critic, critic_info, state.critic)
        if normalize_observations:
            observations = normalizers.observe(observations, step.obs, step.valid)
        updated = policy_finite & critic_finite
        failures = jnp.where(updated & (step.valid.mean() >= 0.5), 0, state.failures + 1)
        metrics = {
            **_account(episodes, step),
            "nonfinite": (episodes.nonfinite - state.episodes.nonfinite).sum(),
            "skipped": 1.0 - updated,
            **{f"policy/{name}": value for name, value in policy_info.items()},
            **{f"critic/{name}": value for name, value in critic_info.items()},
            **estimates,
        }
        return TrainState(policy, critic, observations, reward_scale, episodes, key, state.iteration + 1, failures), metrics

    return init, train_step


def _kept_if_finite(new: Fit, info: Metrics, before: Fit) -> tuple[Fit, Bool[Array, ""]]:
    """One network's update, left out if it is not finite: policy and critic each stand for themselves."""
    finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves((new, info["loss"]))]).all()
    return jax.tree.map(lambda after, before: jnp.where(finite, after, before), new, before), finite


def _roll_out(
    env: Env, algorithm: Algorithm, state: TrainState, keys: Key[Array, "T N"], episode_length: int
) -> tuple[Episodes, Transition]:
    """Every device rolls out its own worlds; what they saw is known to all."""

    def share(actor: Fitted, episodes: Episodes, keys: Key[Array, "T n"]) -> tuple[Episodes, Transition]:
        return rollout(env, acting(algorithm.policy, actor), episodes, keys, episode_length=episode_length)

    actor = Fitted(state.policy.params, state.observations)
    episodes, step = devices.divided(share, (None, 0, 1), (0, 1))(actor, state.episodes, keys)
    return episodes, devices.gather(step)


def acting(policy: Policy, actor: Fitted) -> Act:
    """Actions drawn from the policy, and their log-probabilities."""

    def act(keys: Array, obs: Array) -> tuple[Array, Array]:
        distribution = policy.apply(actor.params, normalizers.normalize(actor.observations, obs))
        action = jax.vmap(gaussian.sample)(keys, distribution)
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
    """The samples the updates learn from: standardised advantages and the critic's target, both from the critic that acted."""
    obs, next_obs = (normalizers.normalize(state.observations, x) for x in (step.obs, step.next_obs))
    quantiles, next_quantiles = (algorithm.critic.predict(state.critic.params, x) for x in (obs, next_obs))
    discount, trace = decay(step.terminated, step.truncated, gamma=gamma, lam=lam)
    residual = algorithm.residual(reward, discount, quantiles, next_quantiles)
    advantage = lambda_sum(residual, discount * trace)
    reach = trace if algorithm.critic.lam is None else decay(step.terminated, step.truncated, gamma=gamma, lam=algorithm.critic.lam).trace
    target = algorithm.critic.target(key, reward, discount, reach, quantiles, next_quantiles)
    mean, std = advantage.mean(where=step.valid), advantage.std(where=step.valid)
    standard = jnp.where(step.valid, (advantage - mean) / (std + 1e-8), 0)
    value = quantiles.mean(-1)
    batch = Batch(obs, step.action, step.log_prob, standard, value, target, reward, discount, next_obs, step.valid)
    continues = 1.0 - (step.terminated | step.truncated)
    metrics = {
        "critic/value": value.mean(),
        "critic/explained_variance": explained_variance(value, lambda_return(reward, discount, trace, quantiles, next_quantiles)),
        **diagnose(reward, discount, continues, quantiles, next_quantiles),
    }
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch), metrics


def _account(episodes: Episodes, step: Transition) -> Metrics:
    """Returns and lengths of the last episodes, in rewards that are not scaled."""
    return {
        "episode_return": jnp.nanmean(episodes.last_total),
        "episode_length": jnp.nanmean(episodes.last_steps),
        "episodes": (step.terminated | step.truncated).sum(),
        "reward": step.reward.mean(),
    }
