"""DPPO on Hopper in one file: PPO with a quantile critic and distributional GAE.

    python examples/dppo.py --total-steps 1000000 --seed 0

DPPO differs from PPO in three places, marked (1) to (3): the critic predicts K quantiles of the
return, the advantage sums distributional TD errors and the targets are samples of the return
distribution, and the loss is the quantile-Huber loss.

This file computes what `dgae_jax.train(dgae_jax.preset("tuned", "dppo", "hopper"))` computes, up to
rounding, with the same random keys. It leaves out what does not change these numbers: masks for
environments that turn non-finite, bounds on outliers in the running statistics, several devices,
and files.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
import tyro
from flax.linen.initializers import constant, orthogonal
from flax.training.train_state import TrainState

import dgae_jax
from dgae_jax.maths import gaussian
from dgae_jax.maths.gaussian import Gaussian
from dgae_jax.maths.returns import decay, dgae, sr_lambda_target
from dgae_jax.maths.transport import quantile_huber_loss


@dataclass(frozen=True)
class Config:
    """Hyperparameters, those of the preset for Hopper."""

    seed: int = 0
    physics: str = "jax"
    total_steps: int = 1_000_000
    num_envs: int = 16
    num_steps: int = 128
    episode_length: int = 1000
    gamma: float = 0.995
    gae_lambda: float = 0.95
    hidden: tuple[int, ...] = (64, 64)
    initial_std: float = 1.0
    quantiles: int = 64
    kappa: float = 1.0
    clip_eps: float = 0.2
    learning_rate: float = 3e-4
    epochs: int = 10
    minibatches: int = 32
    max_grad_norm: float = 0.5


class Torso(nn.Module):
    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, x):
        for width in self.hidden:
            x = nn.tanh(nn.Dense(width, kernel_init=orthogonal(2**0.5))(x))
        return x


class Policy(nn.Module):
    hidden: tuple[int, ...]
    actions: int
    initial_std: float

    @nn.compact
    def __call__(self, obs) -> Gaussian:
        mean = nn.Dense(self.actions, kernel_init=orthogonal(0.01))(Torso(self.hidden)(obs))
        log_std = self.param("log_std", constant(jnp.log(self.initial_std)), (self.actions,))
        return Gaussian(mean, jnp.broadcast_to(log_std, mean.shape))


class Critic(nn.Module):
    """(1) Quantiles of the return; PPO has one value."""

    hidden: tuple[int, ...]
    quantiles: int

    @nn.compact
    def __call__(self, obs):
        return nn.Dense(self.quantiles, kernel_init=orthogonal(1.0))(Torso(self.hidden)(obs))


class Statistics(NamedTuple):
    n: jax.Array
    mean: jax.Array
    squares: jax.Array  # sum of squared deviations from the mean

    @property
    def std(self) -> jax.Array:
        std = jnp.sqrt(self.squares / jnp.maximum(self.n, 1))
        return jnp.where(self.n > 0, jnp.maximum(std, 1e-6), 1.0)


def update_statistics(old: Statistics, samples: jax.Array) -> Statistics:
    """Add samples [T, N, …] by Welford's method."""
    n = old.n + samples.shape[0] * samples.shape[1]
    deviation = samples - old.mean
    mean = old.mean + deviation.sum((0, 1)) / n
    return Statistics(n, mean, old.squares + (deviation * (samples - mean)).sum((0, 1)))


def normalize(statistics: Statistics, obs: jax.Array) -> jax.Array:
    return jnp.clip((obs - statistics.mean) / statistics.std, -10.0, 10.0)


class Episodes(NamedTuple):
    env: Any
    steps: jax.Array
    total: jax.Array
    last_total: jax.Array  # return of the last finished episode; NaN before the first


class State(NamedTuple):
    policy: TrainState
    critic: TrainState
    obs_stats: Statistics
    return_stats: Statistics  # of discounted returns; their std divides rewards
    discounted: jax.Array  # discounted return so far in each env
    episodes: Episodes
    key: jax.Array


def make_train(config: Config):
    """Return `init(key) -> state` and `train_step(state) -> (state, mean episode return)`."""
    env: Any = dgae_jax.make_env("hopper", physics=config.physics)
    policy: Any = Policy(config.hidden, env.action_size, config.initial_std)
    critic: Any = Critic(config.hidden, config.quantiles)
    size = config.num_envs * config.num_steps
    gradient_steps = config.total_steps * config.epochs * config.minibatches // size
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.adam(optax.linear_schedule(config.learning_rate, 0.0, gradient_steps), eps=1e-5),
    )

    def init(key: jax.Array) -> State:
        policy_key, critic_key, env_key, key = jax.random.split(key, 4)
        obs, zero, zeros = map(jnp.zeros, (env.observation_size, (), config.num_envs))
        env_state = jax.vmap(env.reset)(jax.random.split(env_key, config.num_envs))

        def network(module: nn.Module, key: jax.Array) -> TrainState:
            params = module.init(key, obs)
            return TrainState.create(apply_fn=module.apply, params=params, tx=optimizer)

        networks = network(policy, policy_key), network(critic, critic_key)
        statistics = Statistics(zero, obs, obs), Statistics(zero, zero, zero)
        episodes = Episodes(env_state, zeros, zeros, jnp.full_like(zeros, jnp.nan))
        return State(*networks, *statistics, zeros, episodes, key)

    def rollout(state: State, keys: jax.Array) -> tuple[Episodes, tuple[jax.Array, ...]]:
        """Take T steps in N envs; a finished episode is followed by a fresh random one."""

        def step(episodes: Episodes, keys: jax.Array):
            act_keys, reset_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
            obs = episodes.env.obs
            distribution = policy.apply(state.policy.params, normalize(state.obs_stats, obs))
            action = jax.vmap(gaussian.sample)(act_keys, distribution)
            log_prob = gaussian.log_prob(distribution, action)
            after = jax.vmap(env.step)(episodes.env, jnp.clip(action, *env.action_range))
            steps, total = episodes.steps + 1, episodes.total + after.reward
            terminated = after.done > 0  # what follows is worth 0
            truncated = ~terminated & (steps >= config.episode_length)  # what follows has its value
            fresh, zeros = jax.vmap(env.reset)(reset_keys), jnp.zeros_like(total)
            ended = Episodes(fresh, zeros, zeros, last_total=total)
            going_on = Episodes(after, steps, total, episodes.last_total)
            choose = jax.vmap(lambda done, *trees: jax.tree.map(partial(jnp.where, done), *trees))
            transition = obs, action, log_prob, after.reward, terminated, truncated, after.obs
            return choose(terminated | truncated, ended, going_on), transition

        return jax.lax.scan(step, state.episodes, keys)

    def scale_rewards(state: State, reward: jax.Array, done: jax.Array):
        """Divide rewards by the standard deviation of the discounted return."""

        def forward(discounted, inputs):
            reward, done = inputs
            discounted = config.gamma * discounted + reward
            return discounted * (1 - done), discounted

        discounted, returns = jax.lax.scan(forward, state.discounted, (reward, done))
        return_stats = update_statistics(state.return_stats, returns)
        return reward / return_stats.std, discounted, return_stats

    def policy_loss(params, obs, action, log_prob_before, advantage) -> jax.Array:
        """Clipped surrogate −E[min(ρA, clip(ρ, 1 ± ε)A)], ρ = π(a|s)/π_old(a|s)."""
        log_prob = gaussian.log_prob(policy.apply(params, obs), action)
        ratio = jnp.exp(log_prob - log_prob_before)
        clipped = jnp.clip(ratio, 1 - config.clip_eps, 1 + config.clip_eps)
        return -jnp.minimum(ratio * advantage, clipped * advantage).mean()

    def critic_loss(params, obs, target) -> jax.Array:
        """(3) Quantile-Huber loss; PPO has ½(V − target)²."""
        return quantile_huber_loss(critic.apply(params, obs), target, kappa=config.kappa).mean()

    def fit(loss, network: TrainState, key: jax.Array, *data: jax.Array) -> TrainState:
        """Make `epochs` passes over shuffled data [T, N, …], in minibatches."""
        data = jax.tree.map(lambda x: x.reshape(size, *x.shape[2:]), data)

        def minibatch_step(network, rows):
            gradient = jax.grad(loss)(network.params, *(x[rows] for x in data))
            return network.apply_gradients(grads=gradient), None

        def epoch(network, key):
            order = jax.random.permutation(key, size).reshape(config.minibatches, -1)
            return jax.lax.scan(minibatch_step, network, order)

        return jax.lax.scan(epoch, network, jax.random.split(key, config.epochs))[0]

    @jax.default_matmul_precision("highest")  # TF32 ruins training on GPUs that default to it
    def train_step(state: State) -> tuple[State, jax.Array]:
        act_key, target_key, policy_key, critic_key, key = jax.random.split(state.key, 5)
        keys = jax.random.split(act_key, (config.num_steps, config.num_envs))
        episodes, (obs, action, log_prob, reward, *ends, next_obs) = rollout(state, keys)
        obs_stats = update_statistics(state.obs_stats, obs)  # for the next iteration
        obs, next_obs = (normalize(state.obs_stats, x) for x in (obs, next_obs))
        terminated, truncated = ends
        reward, discounted, return_stats = scale_rewards(state, reward, terminated | truncated)

        quantiles, next_quantiles = (critic.apply(state.critic.params, x) for x in (obs, next_obs))
        factors = {"gamma": config.gamma, "lam": config.gae_lambda}
        # (2) PPO: gae(reward, value, next_value, …), and the target is lambda_return(…)
        advantage = dgae(reward, quantiles, next_quantiles, *ends, **factors)
        target = sr_lambda_target(target_key, reward, *decay(*ends, **factors), next_quantiles)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)

        actor = fit(policy_loss, state.policy, policy_key, obs, action, log_prob, advantage)
        values = fit(critic_loss, state.critic, critic_key, obs, target)
        state = State(actor, values, obs_stats, return_stats, discounted, episodes, key)
        return state, jnp.nanmean(episodes.last_total)

    return jax.jit(init), jax.jit(train_step)


def main(config: Config) -> None:
    """Train, and print the mean return of the last episodes."""
    init, train_step = make_train(config)
    state, samples = init(jax.random.key(config.seed)), config.num_envs * config.num_steps
    for iteration in range(1, config.total_steps // samples + 1):
        state, episode_return = train_step(state)
        if iteration % 10 == 0:
            print(f"{iteration * samples:>10,} steps   return {episode_return:8.1f}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Config))
