"""Evaluation: returns of a trained policy's mean action, and their statistics."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.learn.types import InferenceState
from dgae_jax.maths.statistics import bootstrap_interval, iqm, sample_cvar
from dgae_jax.run import checkpoint
from dgae_jax.run.episodes import gymnasium_returns, jax_returns
from dgae_jax.run.options import engine_of, eval_env_id
from dgae_jax.run.runtime import Watch, unwatched
from dgae_jax.run.terminal import counted


def evaluate_run(
    run_dir: Path, config: ResolvedConfig, *, which: str, **how: Any
) -> dict[str, Any]:
    """Evaluate a run's latest or best checkpoint; `how` as in `evaluate_policies`."""
    found = checkpoint.load_networks(run_dir, config, which)
    return {**evaluate_policies(found.policy, config, **how), "checkpoint": found.path.name}


def evaluate_policies(
    policies: InferenceState,
    config: ResolvedConfig,
    *,
    engine: str | None = None,
    episodes: int,
    seed: int = 0,
    watch: Watch = unwatched,
) -> dict[str, Any]:
    """Compute undiscounted returns of the policies of a run, one per trained seed.

    Args:
        policies: with a leading axis of trained seeds.
        config: the run.
        engine: one of `engines_of`; by default the first.
        episodes: initial states, the same for every policy.
        seed: determines the initial states.
        watch: told the progress; what it raises breaks the evaluation off.

    Returns:
        What `evaluation.json` holds: `summary` of all returns, and of each seed in `seeds`.

    Raises:
        ConfigError: the engine is none of `engines_of`.
    """
    engine, env = engine_of(config, engine), eval_env_id(config)
    in_gymnasium, returns = engine == "gymnasium", []
    play = gymnasium_returns if in_gymnasium else jax_returns
    played = config if in_gymnasium else dataclasses.replace(config, physics=engine)
    for i in range(config.num_seeds):
        what = f"evaluating {counted(episodes, 'episode')} in {env} ({engine})"
        what += f", seed {config.seed + i}" if config.num_seeds > 1 else ""

        def progress(text: str, what: str = what) -> None:
            watch(f"{what}: {text}")

        policy = jax.tree.map(lambda x, i=i: x[i], policies)
        returns.append(play(policy, played, episodes, seed, progress))
    return {
        "engine": engine,
        "env": env,
        "episodes": episodes * config.num_seeds,
        **summary(np.concatenate(returns)),
        **(seed_statistics(returns) if len(returns) > 1 else {}),
        "seeds": [{"seed": config.seed + i, **summary(x)} for i, x in enumerate(returns)],
    }


@np.errstate(invalid="ignore")  # of a return that is not finite
def summary(returns: np.ndarray) -> dict[str, Any]:
    """Return mean, standard deviation, tails and quantiles of returns [E], and each of them."""
    tails, quantiles = (0.05, 0.1, 0.25), (0.05, 0.25, 0.5, 0.75, 0.95)
    return {
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_cvar": {str(share): sample_cvar(returns, share) for share in tails},
        "return_quantiles": {str(q): float(np.quantile(returns, q)) for q in quantiles},
        "returns": [round(float(r), 4) for r in returns],
    }


def seed_statistics(returns: list[np.ndarray]) -> dict[str, Any]:
    """Return statistics of the mean returns of trained seeds: mean, std (n − 1) and IQM.

    The 95 % percentile bootstrap intervals are too narrow with few seeds.
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
    """Return an evaluation in one line."""
    seeds = len(result["seeds"])
    episodes = counted(result["episodes"] // seeds, "episode")
    where = f"of the deterministic policy in {result['env']} ({result['engine']})"
    if seeds == 1:
        mean, std = result["return_mean"], result["return_std"]
        return f"return {mean:,.1f} ± {std:,.1f} over {episodes} {where}"
    low, high = result["interval"]
    mean = f"return {result['seeds_mean']:,.1f}, mean of {seeds} seeds × {episodes} {where}"
    spread = f"standard deviation {result['seeds_std']:,.1f} over seeds"
    return f"{mean}; {spread}, 95 % interval of the mean {low:,.1f} to {high:,.1f}"
