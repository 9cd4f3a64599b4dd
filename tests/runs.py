"""Small runs, for the tests of what a run leaves on disk."""

import dataclasses
import tempfile
from pathlib import Path

import jax.numpy as jnp

import dgae_jax as dg
from dgae_jax.run import checkpoint, metrics
from dgae_jax.run.options import RunOptions
from tests.helpers import SMALL

ITERATIONS = 8
QUIET = RunOptions(
    cache_dir=str(Path(tempfile.gettempdir()) / "dgae_jax_tests"), episodes=1, checkpoint_every=ITERATIONS // 2 * SMALL.samples
)


def small(algo="ppo", physics="native", seeds=1):
    policy = dg.PolicyConfig(hidden=(8,)) if "trpo" in algo else SMALL.policy
    critic = SMALL.critic if algo[0] == "d" else dataclasses.replace(SMALL.critic, quantiles=64)
    steps = ITERATIONS * SMALL.samples
    shape = {"total_steps": steps, "episode_length": 20, "num_seeds": seeds}
    return dataclasses.replace(SMALL, algo=algo, physics=physics, policy=policy, critic=critic, **shape)


def saved(state, directory, steps, **keep):
    """A checkpoint of `state` after so many samples."""
    then = state._replace(iteration=jnp.full_like(state.iteration, steps // SMALL.samples))
    return checkpoint.save(directory, SMALL, checkpoint.arrays_of(then), steps, **keep)


def timeless(run_dir):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in metrics.read(run_dir / "metrics.jsonl")]


def last(run_dir):
    return max((run_dir / "checkpoints").iterdir())
