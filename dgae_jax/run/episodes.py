"""Episodes of trained policies: greedy in Gymnasium and in JAX, sampled for Monte Carlo returns.

The one place that steps episodes outside training; evaluation, calibration and video share it.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import CUSTOM_ENVS, spec_of
from dgae_jax.learn.build import make_greedy, make_policy, make_task
from dgae_jax.learn.iteration import sampler
from dgae_jax.learn.parallel import Trainer, make_trainer
from dgae_jax.learn.rollout import Episodes, rollout, start
from dgae_jax.learn.types import InferenceState, Transition
from dgae_jax.run.options import eval_env_id
from dgae_jax.run.runtime import Watch, compile_in_thread

CHUNK, SAMPLED_CHUNK = 50, 100
"""Steps between looks at signals and clock, with mean and with sampled actions."""


class EvalStep(NamedTuple):
    """One step of E episodes side by side."""

    obs: Float[np.ndarray, "E O"]
    """Observations before the step."""
    reward: Float[np.ndarray, " E"]
    """Rewards, 0 where the episode has ended before."""
    alive: Bool[np.ndarray, " E"]
    """False where the episode has ended, in this step or before."""
    terminated: Bool[np.ndarray, " E"]
    """True where the episode ended in this step other than by a time limit."""


def episode_seeds(seed: int, episodes: int) -> np.ndarray:
    """Return a 64-bit number per initial state [E]; no other `seed` shares one (chance 2⁻⁶⁴)."""
    sequences = (np.random.SeedSequence((seed, i)) for i in range(episodes))
    return np.array([each.generate_state(1, np.uint64)[0] for each in sequences])


def make_eval_env(config: ResolvedConfig, max_steps: int | None = None) -> Any:
    """Return the task in Gymnasium with a time limit, by default that of training."""
    # here, so that training alone does not import Gymnasium
    from gymnasium.wrappers import TimeLimit

    from dgae_jax.envs.gymnasium import make_gym_env

    limit = config.episode_length if max_steps is None else max_steps
    if spec_of(config.env).on_host:  # its own limit may be shorter
        return TimeLimit(make_gym_env(eval_env_id(config)), limit)
    return make_gym_env(eval_env_id(config), max_episode_steps=limit)


def time_limit(config: ResolvedConfig) -> int:
    """Return the most steps of an episode: the run's limit, or a shorter one of Gymnasium's."""
    gymnasium_id = spec_of(config.env).gymnasium_id
    if gymnasium_id is None:
        return config.episode_length
    from dgae_jax.envs.gymnasium import make_gym_env

    env = make_gym_env(gymnasium_id)
    env.close()
    own = env.spec and env.spec.max_episode_steps
    return min(config.episode_length, own or config.episode_length)


def gymnasium_steps(
    envs: Sequence[Any],
    act: Callable[[np.ndarray], np.ndarray],
    seeds: Sequence[int] | np.ndarray,
) -> Iterator[EvalStep]:
    """Play one episode per Gymnasium env, with one batched policy call per step.

    Args:
        envs: one env per episode; they stay open.
        act: `act(obs [E, O]) -> action [E, A]`.
        seeds: the seed of each initial state.

    Yields:
        The steps of all episodes, until the last one has ended.
    """
    pairs = zip(envs, seeds, strict=True)
    obs = np.stack([env.reset(seed=int(seed))[0] for env, seed in pairs])
    alive = np.full(len(envs), True)
    while alive.any():
        before, actions = obs.copy(), act(obs.astype(np.float32))
        reward, over = np.zeros(len(envs)), np.full(len(envs), False)
        for i in map(int, np.flatnonzero(alive)):
            obs[i], reward[i], over[i], truncated, _ = envs[i].step(actions[i])
            alive[i] = not (over[i] or truncated)
        yield EvalStep(before, reward, alive.copy(), over)


@lru_cache(maxsize=1)
def _programs(config: ResolvedConfig, custom: Any) -> tuple[Any, Any, Trainer]:
    """Return the jitted policy, steps of all envs, and trainer; `custom` is an env object."""
    env = make_task(config)
    greedy = make_greedy(env, config)

    def advance(policy: InferenceState, episodes: tuple, count: int) -> tuple:
        # of env states, returns so far, and True where an episode still runs
        def one(_, episodes: tuple) -> tuple:
            state, total, alive = episodes
            state = jax.vmap(env.step)(state, greedy(policy, state.obs))
            return state, total + jnp.where(alive, state.reward, 0), alive & (state.done == 0)

        return jax.lax.fori_loop(0, count, one, episodes)

    return jax.jit(greedy), jax.jit(advance), make_trainer(env, 1)


def _progress(step: int, config: ResolvedConfig, alive: int) -> str:
    return f"step {step:,} of at most {config.episode_length:,}, {alive} still running"


def gymnasium_returns(
    policy: InferenceState, config: ResolvedConfig, episodes: int, seed: int, watch: Watch
) -> np.ndarray:
    """Return undiscounted returns [E] of the mean action in Gymnasium, side by side."""
    envs = [make_eval_env(config) for _ in range(episodes)]
    act, *_ = _programs(config, CUSTOM_ENVS.get(config.env))
    shape = (episodes, *envs[0].observation_space.shape)
    compile_in_thread(act, policy, np.zeros(shape, np.float32), watch=watch)
    total, seeds = np.zeros(episodes), episode_seeds(seed, episodes)
    steps = gymnasium_steps(envs, lambda obs: np.asarray(act(policy, obs)), seeds)
    for number, step in enumerate(steps):
        total += step.reward
        if number % CHUNK == 0:
            watch(_progress(number, config, int(step.alive.sum())))
    for env in envs:
        env.close()
    return total


def jax_returns(
    policy: InferenceState, config: ResolvedConfig, episodes: int, seed: int, watch: Watch
) -> np.ndarray:
    """Return undiscounted returns [E] of the mean action in the physics of `config`."""
    _, advance, trainer = _programs(config, CUSTOM_ENVS.get(config.env))
    state = _fresh_envs(config, trainer, seed, episodes, watch)
    now = state, jnp.zeros_like(state.reward), jnp.full(episodes, True)
    compile_in_thread(advance, policy, now, 1, watch=watch, what="compiling steps")
    for step in range(0, config.episode_length, CHUNK):
        if not (alive := int(now[2].sum())):
            break
        watch(_progress(step, config, alive))
        now = advance(policy, now, min(CHUNK, config.episode_length - step))
    return np.asarray(now[1], np.float64)


def _fresh_envs(
    config: ResolvedConfig, trainer: Trainer, seed: int, episodes: int, watch: Watch
) -> Any:
    """Return env states at the beginning of an episode [E].

    They are taken from fresh training states, to share their program: a reset of Brax's takes half
    a minute to compile.
    """
    size = config.num_seeds * config.num_envs
    sequences = [np.random.SeedSequence((seed, i)) for i in range(-(-episodes // size))]
    numbers = [each.generate_state(config.num_seeds) for each in sequences]
    keys = [jnp.stack([jax.random.key(int(n)) for n in each]) for each in numbers]
    compile_in_thread(trainer.init, config, keys[0], watch=watch, what="compiling resets")
    envs = [trainer.init(config, each).episodes.env for each in keys]

    def joined(*parts: jax.Array) -> jax.Array:
        return jnp.concatenate([x.reshape(size, *x.shape[2:]) for x in parts])[:episodes]

    return jax.tree.map(joined, *envs)


def sampled_steps(
    policy: InferenceState,
    config: ResolvedConfig,
    key: jax.Array,
    num_envs: int,
    steps: int,
    watch: Watch,
) -> Iterator[Transition]:
    """Sample actions of one policy in fresh envs without a time limit.

    Yields transitions [SAMPLED_CHUNK, num_envs], until at least `steps` were taken.
    """
    env = make_task(config)
    network = make_policy(env, config)

    @jax.jit
    @jax.default_matmul_precision("highest")  # as in training
    def advance(policy: InferenceState, episodes: Episodes, keys: jax.Array):
        return rollout(env, sampler(network, policy), episodes, keys, episode_length=2**30)

    begin, draw = jax.random.split(key)
    episodes = jax.jit(lambda keys: start(env, keys))(jax.random.split(begin, num_envs))
    total = -(-steps // SAMPLED_CHUNK) * SAMPLED_CHUNK
    keys = jax.random.split(draw, (total // SAMPLED_CHUNK, SAMPLED_CHUNK, num_envs))
    compile_in_thread(advance, policy, episodes, keys[0], watch=watch)
    for i, each in enumerate(keys):
        watch(f"playing step {i * SAMPLED_CHUNK:,} of {total:,} in {num_envs} envs")
        episodes, step = advance(policy, episodes, each)
        yield step
