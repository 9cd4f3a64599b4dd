"""What several test files share: a small configuration, the commands, files made by hand."""

import dataclasses
import hashlib
import json
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp

import dgae_jax as dg
from dgae_jax.cli import main
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
    """The small configuration of an algorithm, without the settings that it does not use."""
    policy = dg.PolicyConfig(hidden=(8,)) if "trpo" in algo else SMALL.policy
    critic = (
        SMALL.critic if algo.startswith("d") else dataclasses.replace(SMALL.critic, quantiles=None)
    )
    return dataclasses.replace(SMALL, algo=algo, policy=policy, critic=critic, **changes)


TINY = ["--physics", "native", "--num-envs", "4", "--num-steps", "16", "--policy.minibatches", "4", "--critic.minibatches", "4",
        "--policy.hidden", "8", "--critic.hidden", "8", "--cache-dir", str(Path(tempfile.gettempdir()) / "dgae_jax_tests")]  # fmt: skip
"""Flags of a small run; processes share its compiled programs."""


def command(name):
    """The function of a command."""
    return main.command(name)


def signed(arrays):
    """Any bytes with the header of a checkpoint."""
    return (
        json.dumps(
            {"schema": checkpoint.SCHEMA, "sha256": hashlib.sha256(arrays).hexdigest()}
        ).encode()
        + b"\n"
        + arrays
    )


def distance(a, b):
    """The largest difference of two trees."""
    return max(jax.tree.leaves(jax.tree.map(lambda x, y: float(jnp.abs(x - y).max()), a, b)))
