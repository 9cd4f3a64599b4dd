"""Small runs, for the tests of what a run leaves on disk."""

import shutil
import tempfile
from pathlib import Path

import jax.numpy as jnp

from dgae_jax.configs.resolved import resolve
from dgae_jax.run import checkpoint, directory, metrics
from dgae_jax.run.options import RunOptions
from tests import helpers

SMALL = resolve(helpers.SMALL)
"""The small configuration, resolved."""

ITERATIONS = 8
QUIET = RunOptions(
    cache_dir=str(Path(tempfile.gettempdir()) / "dgae_jax_tests"),
    episodes=1,
    checkpoint_every=ITERATIONS // 2 * SMALL.samples_per_iteration,
)


def small(algo="ppo", physics="native", seeds=1):
    """Return the small run of an algorithm, resolved."""
    shape = {
        "total_steps": ITERATIONS * SMALL.samples_per_iteration,
        "episode_length": 20,
        "num_seeds": seeds,
    }
    return resolve(helpers.small(algo, physics=physics, **shape))


def saved(state, directory, steps, **keep):
    """Save a checkpoint of `state` after so many samples."""
    then = state._replace(
        iteration=jnp.full_like(state.iteration, steps // SMALL.samples_per_iteration)
    )
    return checkpoint.save(directory, SMALL, checkpoint.arrays_of(then), steps, **keep)


def timeless(run_dir):
    return [
        {k: v for k, v in row.items() if k != "seconds"}
        for row in metrics.read(run_dir / "metrics.jsonl")
    ]


def last(run_dir):
    return max((run_dir / "checkpoints").iterdir())


def stopped_half_way(whole, half):
    """Copy a finished run as a crash after its first checkpoint would have left it."""
    shutil.copytree(whole, half)
    last(half).unlink()
    (half / "evaluation.json").unlink()
    with (half / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 9, "ste')


def create(path, config=SMALL):
    """Make a run directory in which nothing was trained yet."""
    with directory.created(path, config, RunOptions()):
        pass
