"""What a trained policy is worth: episodes of its mean action in one of several engines."""

import dataclasses
import warnings
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import GIVEN, spec_of
from dgae_jax.learn import play
from dgae_jax.learn.build import make_greedy, make_task, make_trainer
from dgae_jax.learn.parallel import Trainer
from dgae_jax.learn.types import InferenceState
from dgae_jax.maths.statistics import bootstrap_interval, iqm, sample_cvar
from dgae_jax.run import checkpoint, files
from dgae_jax.run.options import engine_of, eval_env_id
from dgae_jax.run.runtime import Watch, compile_in_thread, unwatched
from dgae_jax.run.terminal import counted

CHUNK = 50
"""Steps between looks at signals and clock."""


def time_limit(config: ResolvedConfig) -> int:
    """Steps of the longest episode: the run's own limit, or that of a task of Gymnasium's if it is shorter."""
    gymnasium_id = spec_of(config.env).gymnasium_id
    if gymnasium_id is None:
        return config.episode_length
    from dgae_jax.envs.gymnasium import make_world

    world = make_world(gymnasium_id)
    world.close()
    own = world.spec and world.spec.max_episode_steps
    return min(config.episode_length, own or config.episode_length)


def make_eval_env(config: ResolvedConfig) -> Any:
    """A world of the task in Gymnasium, with the time limit that episodes in training have."""
    import gymnasium  # here, so that training alone does not import it

    if spec_of(config.env).gymnasium_id is None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that v4 is not the latest version is known
            return gymnasium.make(eval_env_id(config), max_episode_steps=config.episode_length)
    from dgae_jax.envs.gymnasium import make_world

    return gymnasium.wrappers.TimeLimit(
        make_world(eval_env_id(config)), config.episode_length
    )  # beside the task's own


def default_path(source: Path, engine: str, which: str) -> Path:
    """The file of an evaluation after training, one for each engine and choice of checkpoint; beside a policy's own file."""
    return files.beside(
        source, f"evaluation-{engine}{'' if which == 'latest' else f'-{which}'}.json"
    )


def episode_seeds(seed: int, episodes: int) -> np.ndarray:
    """A number of 64 bits for each initial state [E]; no other `seed` has any of them, but by a chance of 2⁻⁶⁴ per pair."""
    return np.array(
        [np.random.SeedSequence((seed, i)).generate_state(1, np.uint64)[0] for i in range(episodes)]
    )


def evaluate_run(
    run_dir: Path,
    config: ResolvedConfig,
    *,
    which: str,
    engine: str | None = None,
    episodes: int,
    seed: int = 0,
    watch: Watch = unwatched,
) -> dict[str, Any]:
    """`evaluate_policies` for a run's latest checkpoint or the best of its evaluations; raises as it and `restore.trained`."""
    engine = engine_of(config, engine)
    found = checkpoint.load_networks(run_dir, config, which)
    result = evaluate_policies(
        found.policy, config, engine=engine, episodes=episodes, seed=seed, watch=watch
    )
    return {**result, "checkpoint": found.path.name}


def evaluate_policies(
    policies: InferenceState,
    config: ResolvedConfig,
    *,
    engine: str | None = None,
    episodes: int,
    seed: int = 0,
    watch: Watch = unwatched,
) -> dict[str, Any]:
    """Undiscounted returns of the policies of a run, one per trained seed: `returns` are all of them, `seeds` each one's.

    Every policy plays the same `episodes` initial states, which `seed` determines. `engine` is the first of `engines_of` unless
    another is named; raises ConfigError if it is none of them. May be broken off by `watch`, which is told at least every `CHUNK` steps.
    """
    engine = engine_of(config, engine)
    run = _in_gymnasium if engine == "gymnasium" else _in_jax
    per_run, where = [], f"{eval_env_id(config)} ({engine})"
    for i in range(config.num_seeds):
        of = f", seed {config.seed + i}" if config.num_seeds > 1 else ""
        one = jax.tree.map(lambda x, i=i: x[i], policies)
        progress = _Progress(
            watch,
            f"evaluating {counted(episodes, 'episode')} in {where}{of}",
            config.episode_length,
        )
        per_run.append(run(one, config, engine, episodes, seed, progress))
    return {
        "engine": engine,
        "env": eval_env_id(config),
        "episodes": episodes * config.num_seeds,
        **summary(np.concatenate(per_run)),
        **(seed_statistics(per_run) if len(per_run) > 1 else {}),
        "seeds": [
            {"seed": config.seed + i, **summary(returns)} for i, returns in enumerate(per_run)
        ],
    }


class _Progress(NamedTuple):
    """Says how far an evaluation is."""

    watch: Watch
    what: str
    limit: int

    def __call__(self, step: int, alive: int) -> None:
        self.watch(f"{self.what}: step {step:,} of at most {self.limit:,}, {alive} still running")


@lru_cache(maxsize=1)
def _programs(
    config: ResolvedConfig, given: Any
) -> tuple[Trainer, Callable[[InferenceState, play.Play, int], play.Play]]:
    """In the physics of `config`, for the object that its task's name stands for now, if it does for one: the trainer, and
    `go_on(policy, episodes, until) -> episodes`.
    """
    env = make_task(config)
    greedy = make_greedy(env, config)
    return make_trainer(env, 1), jax.jit(
        lambda policy, now, until: play.play(env, lambda obs: greedy(policy, obs), now, until)
    )


def _fresh_worlds(config: ResolvedConfig, seed: int, episodes: int, progress: _Progress) -> Any:
    """Environment states at the beginning of an episode [E].

    They are taken from fresh training states: a reset of Brax's takes half a minute to compile, and JAX's cache already has
    this program, or will.
    """
    init = _programs(config, GIVEN.get(config.env))[0].init
    batches = -(-episodes // (config.num_seeds * config.num_envs))
    numbers = [
        np.random.SeedSequence((seed, i)).generate_state(config.num_seeds) for i in range(batches)
    ]
    keys = [jnp.stack([jax.random.key(int(n)) for n in each]) for each in numbers]
    compile_in_thread(
        init, config, keys[0], watch=progress.watch, what=f"{progress.what}: compiling resets"
    )
    worlds = [
        jax.tree.map(
            lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]),
            init(config, each).episodes.env,
        )
        for each in keys
    ]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[:episodes], *worlds)


def _in_jax(
    policy: InferenceState,
    config: ResolvedConfig,
    engine: str,
    episodes: int,
    seed: int,
    progress: _Progress,
) -> np.ndarray:
    config = dataclasses.replace(config, physics=engine)
    now, go_on = (
        play.begin(_fresh_worlds(config, seed, episodes, progress)),
        _programs(config, GIVEN.get(config.env))[1],
    )
    compile_in_thread(
        go_on, policy, now, 1, watch=progress.watch, what=f"{progress.what}: compiling steps"
    )
    while (step := int(now.step)) < config.episode_length and (alive := int(now.alive.sum())):
        progress(step, alive)
        now = go_on(policy, now, min(step + CHUNK, config.episode_length))
    return np.asarray(now.total, np.float64)


@lru_cache(maxsize=1)
def _greedy(config: ResolvedConfig, given: Any):
    return jax.jit(make_greedy(make_task(config), config))


def _in_gymnasium(
    policy: InferenceState,
    config: ResolvedConfig,
    engine: str,
    episodes: int,
    seed: int,
    progress: _Progress,
) -> np.ndarray:
    """Gymnasium's own task in C MuJoCo, the referee: episodes side by side, one batched policy call per step."""
    worlds = [make_eval_env(config) for _ in range(episodes)]
    greedy = _greedy(config, GIVEN.get(config.env))
    starts = zip(episode_seeds(seed, episodes), worlds, strict=True)
    obs = np.stack([world.reset(seed=int(number))[0] for number, world in starts])
    compile_in_thread(
        greedy,
        policy,
        obs.astype(np.float32),
        watch=progress.watch,
        what=f"{progress.what}: compiling",
    )
    total, alive, step = np.zeros(episodes), np.full(episodes, True), 0
    while alive.any():
        if step % CHUNK == 0:
            progress(step, int(alive.sum()))
        actions = np.asarray(greedy(policy, obs.astype(np.float32)))
        for i in np.flatnonzero(alive):
            obs[i], reward, terminated, truncated, _ = worlds[i].step(actions[i])
            total[i] += float(reward)
            alive[i] = not (terminated or truncated)
        step += 1
    for world in worlds:
        world.close()
    return total


@np.errstate(invalid="ignore")  # a return that is not finite makes numbers that are not either
def summary(returns: np.ndarray) -> dict[str, Any]:
    """Mean, standard deviation, tails and quantiles of returns [E], and each of them."""
    return {
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_cvar": {str(share): sample_cvar(returns, share) for share in (0.05, 0.1, 0.25)},
        "return_quantiles": {
            str(q): float(np.quantile(returns, q)) for q in (0.05, 0.25, 0.5, 0.75, 0.95)
        },
        "returns": [round(float(r), 4) for r in returns],
    }


def seed_statistics(returns: list[np.ndarray]) -> dict[str, Any]:
    """What separates trained seeds: the mean of their mean returns, its spread, and how sure it is.

    `seeds_std` is the sample standard deviation (n − 1) of the seeds' means; `interval` and `iqm_interval` are 95 % percentile
    bootstrap intervals over seeds, of the mean and of the interquartile mean. With few seeds they are too narrow.
    """
    means = np.array([each.mean() for each in returns])
    return {
        "seeds_mean": float(means.mean()),
        "seeds_std": float(means.std(ddof=1)),
        "interval": [float(x) for x in bootstrap_interval(means, partial(np.mean, axis=-1))],
        "iqm": float(iqm(means)),
        "iqm_interval": [float(x) for x in bootstrap_interval(means)],
    }


def describe(result: dict[str, Any]) -> str:
    """An evaluation in one line."""
    seeds, where = (
        len(result["seeds"]),
        f"of the deterministic policy in {result['env']} ({result['engine']})",
    )
    if seeds == 1:
        return f"return {result['return_mean']:,.1f} ± {result['return_std']:,.1f} over {counted(result['episodes'], 'episode')} {where}"
    low, high = result["interval"]
    spread = f"standard deviation {result['seeds_std']:,.1f} over seeds, 95 % interval of the mean {low:,.1f} to {high:,.1f}"
    return f"return {result['seeds_mean']:,.1f}, mean of {seeds} seeds × {counted(result['episodes'] // seeds, 'episode')} {where}; {spread}"
