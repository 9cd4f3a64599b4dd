"""Small runs, for the tests of what a run leaves on disk."""

import dataclasses
import shutil
import signal
import tempfile
from pathlib import Path

import jax.numpy as jnp
import pytest

from dgae_jax.configs.resolved import resolve
from dgae_jax.run import checkpoint, directory, metrics
from dgae_jax.run.options import RunOptions
from dgae_jax.run.training import train_command
from tests import helpers

SMALL = resolve(helpers.SMALL)
"""The small configuration, resolved."""

ITERATIONS = 8
QUIET = RunOptions(
    cache_dir=str(Path(tempfile.gettempdir()) / "dgae_jax_tests"),
    episodes=1,
    checkpoint_every=ITERATIONS // 2 * SMALL.samples_per_iteration,
)

each_signal = pytest.mark.parametrize(
    ("kind", "code"),
    [
        (signal.SIGTERM, 143),
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow),
    ],
)


def small(algo="ppo", physics="native", seeds=1):
    """Return the small run of an algorithm, resolved."""
    shape = {
        "total_steps": ITERATIONS * SMALL.samples_per_iteration,
        "episode_length": 20,
        "num_seeds": seeds,
    }
    return resolve(helpers.small(algo, physics=physics, **shape))


def exit_code(config, **options):
    """Train, with little to evaluate and nothing to show."""
    return train_command(config, dataclasses.replace(QUIET, **options))


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


def assert_same(ours, theirs):
    """Compare what two runs have left, bit for bit."""
    assert last(ours).read_bytes() == last(theirs).read_bytes()
    assert timeless(ours) == timeless(theirs)
    evaluations = [(run_dir / "evaluations.jsonl").read_bytes() for run_dir in (ours, theirs)]
    assert evaluations[0] == evaluations[1]


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
