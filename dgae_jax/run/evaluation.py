"""What a trained policy is worth: episodes of its mean action in one of three engines."""

import contextlib
import dataclasses
import warnings
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.build import make_greedy, make_task
from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.envs.registry import BRAX, spec_of
from dgae_jax.learn.rollout import evaluate
from dgae_jax.learn.types import TrainState
from dgae_jax.run import checkpoint, files

ENGINES = ("gymnasium", "native", "jax")


def evaluate_state(state: TrainState, config: Config, *, engine: str, episodes: int, seed: int = 0) -> dict[str, Any]:
    """Undiscounted returns of every run in `state`; mean and standard deviation are over all their episodes."""
    if config.env.startswith(BRAX) and engine != "jax":
        raise ConfigError(f"--engine {engine}: must be jax with an environment of Brax's own ({config.env})")
    run = _in_gymnasium if engine == "gymnasium" else _in_jax
    states = [jax.tree.map(lambda x, i=i: x[i], state) for i in range(config.num_seeds)]
    per_run = [run(one, config, engine, episodes, seed) for one in states]
    return {
        "engine": engine,
        "env": referee(config),
        "episodes": episodes * config.num_seeds,
        **_summary(np.concatenate(per_run)),
        "seeds": [{"seed": config.seed + i, **_summary(returns)} for i, returns in enumerate(per_run)],
    }


def evaluate_run(run_dir: Path, config: Config, *, which: str, engine: str, episodes: int, seed: int = 0) -> dict[str, Any]:
    """`evaluate_state` for a run's newest checkpoint or the best of its evaluations.

    Raises ConfigError if the best is asked for and nothing was evaluated.
    """
    if which == "newest":
        state, path = checkpoint.newest(run_dir, config)
    else:
        steps = EvaluationsFile(run_dir / "evaluations.jsonl").best
        if steps is None:
            raise ConfigError(f"--checkpoint {which}: must be newest: {run_dir} has no evaluations")
        state, path = checkpoint.at(run_dir, steps, config)
    return {**evaluate_state(state, config, engine=engine, episodes=episodes, seed=seed), "checkpoint": path.name}


class EvaluationsFile:
    """`evaluations.jsonl`: one row per run and evaluation."""

    def __init__(self, path: Path):
        self.path = path
        self.rows: list[dict[str, Any]] = []
        with contextlib.suppress(OSError):
            self.rows = [row for row, _ in files.whole_rows(path) if _is_evaluation(row)]

    def cut(self, steps: int, runs: int) -> None:
        """Forget what followed the first `steps` samples, and evaluations that lack some of the `runs`."""
        rows_at = Counter(row["steps"] for row in self.rows)
        self.rows = [row for row in self.rows if row["steps"] <= steps and rows_at[row["steps"]] == runs]
        files.replace(self.path, files.json_lines(self.rows))

    def has(self, steps: int) -> bool:
        """Whether the state after `steps` samples was evaluated."""
        return any(row["steps"] == steps for row in self.rows)

    def append(self, steps: int, result: dict[str, Any]) -> None:
        """Note the result of `evaluate_state` after `steps` samples."""
        rows = [{"steps": steps, **{k: one[k] for k in ("seed", "return_mean", "return_std")}} for one in result["seeds"]]
        files.append_rows(self.path, rows)
        self.rows += rows

    def points(self) -> np.ndarray:
        """Steps, mean and standard deviation of every row [E, 3]."""
        return np.array([[row[name] for name in ("steps", "return_mean", "return_std")] for row in self.rows]).reshape(-1, 3)

    @property
    def best(self) -> int | None:
        """Steps of the best evaluation, by the mean over all runs; the later of equal ones."""
        steps, mean, _ = self.points().T
        return max((int(at) for at in steps), key=lambda at: (mean[steps == at].mean(), at), default=None)


def _is_evaluation(row: dict[str, Any]) -> bool:
    """A file may hold anything."""
    steps, *numbers = (row.get(name) for name in ("steps", "seed", "return_mean", "return_std"))
    if not (type(steps) is int and 0 <= steps < 2**53 and all(isinstance(x, float | int) and abs(x) < 1e30 for x in numbers)):
        return False
    return row["return_std"] >= 0


def referee(config: Config) -> str:
    """Gymnasium's name of the task, or Brax's."""
    return spec_of(config.env).referee(config.env_version) or config.env


def _summary(returns: np.ndarray) -> dict[str, Any]:
    worst_first = np.sort(returns)

    def mean_of_worst(share: float) -> float:
        return float(worst_first[: max(1, round(share * len(returns)))].mean())

    return {
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_cvar": {str(share): mean_of_worst(share) for share in (0.05, 0.1, 0.25)},
        "return_quantiles": {str(q): float(np.quantile(returns, q)) for q in (0.05, 0.25, 0.5, 0.75, 0.95)},
        "returns": [round(float(r), 4) for r in returns],
    }


@lru_cache(maxsize=1)
def _greedy(config: Config):
    return jax.jit(make_greedy(make_task(config), config))


@lru_cache(maxsize=1)
def _returns(config: Config, episodes: int):
    """`returns(state, key) -> [E]` in the physics of `config`."""
    env = make_task(config)
    greedy = make_greedy(env, config)

    @jax.jit
    def returns(state: TrainState, key: jax.Array):
        return evaluate(env, lambda obs: greedy(state, obs), key, episodes=episodes, episode_length=config.episode_length)

    return returns


def _in_jax(state: TrainState, config: Config, engine: str, episodes: int, seed: int) -> np.ndarray:
    returns = _returns(dataclasses.replace(config, physics=engine), episodes)
    return np.asarray(returns(state, jax.random.key(seed)), np.float64)


def _in_gymnasium(state: TrainState, config: Config, engine: str, episodes: int, seed: int) -> np.ndarray:
    """Gymnasium's own task in C MuJoCo, the referee: episodes side by side, one batched policy call per step."""
    import gymnasium  # here, so that training alone does not import it

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that v4 is not the newest version is known
        worlds = [gymnasium.make(referee(config), max_episode_steps=config.episode_length) for _ in range(episodes)]
    greedy = _greedy(config)
    obs = np.stack([world.reset(seed=seed + i)[0] for i, world in enumerate(worlds)])
    total, alive = np.zeros(episodes), np.full(episodes, True)
    while alive.any():
        actions = np.asarray(greedy(state, obs.astype(np.float32)))
        for i in np.flatnonzero(alive):
            obs[i], reward, terminated, truncated, _ = worlds[i].step(actions[i])
            total[i] += float(reward)
            alive[i] = not (terminated or truncated)
    for world in worlds:
        world.close()
    return total
