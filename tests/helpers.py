"""Helpers of several test files: a small configuration, checkpoints made by hand."""

import dataclasses
import hashlib
import json
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp

import dgae_jax as dg
from dgae_jax.run import checkpoint

ROOT = Path(__file__).parent.parent

SMALL = dg.Config(
    physics="native",
    total_steps=64 * 20,
    num_envs=4,
    num_steps=16,
    policy=dg.PolicyConfig(hidden=(8,), epochs=2, minibatches=4),
    critic=dg.CriticConfig(hidden=(8,), epochs=2, minibatches=4, quantiles=8),
)


def small(algo, **changes):
    """Return the small configuration of an algorithm, without settings that have no effect."""
    config = dataclasses.replace(SMALL, algo=algo, **changes)
    if "trpo" in algo:
        config = dataclasses.replace(config, policy=dg.PolicyConfig(hidden=(8,)))
    return config if algo.startswith("d") else config.replace(**{"critic.quantiles": None})


CACHE = f"{tempfile.gettempdir()}/dgae_jax_tests"
TINY = f"""--physics native --num-envs 4 --num-steps 16 --policy.hidden 8 --critic.hidden 8
--policy.minibatches 4 --critic.minibatches 4 --cache-dir {CACHE}""".split()
"""Flags of a small run; processes share its compiled programs."""


def signed(arrays):
    """Return any bytes with the header of a checkpoint."""
    header = {"schema": checkpoint.SCHEMA, "sha256": hashlib.sha256(arrays).hexdigest()}
    return json.dumps(header).encode() + b"\n" + arrays


def distance(a, b):
    """Return the largest difference of two trees."""
    return max(jax.tree.leaves(jax.tree.map(lambda x, y: float(jnp.abs(x - y).max()), a, b)))
