"""A trained run, and policies without training."""

from typing import NamedTuple

import jax
import numpy as np
import pytest

import dgae_jax as dg
from dgae_jax.configs.resolved import resolve
from dgae_jax.export import gl
from dgae_jax.learn.types import InferenceState
from dgae_jax.run import checkpoint
from tests.cli import conftest as cli
from tests.runs import exit_code, small

dgae = cli.dgae


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """The directory of a run with two seeds."""
    run_dir = tmp_path_factory.mktemp("runs") / "dppo"
    assert exit_code(small("dppo", seeds=2), run_dir=run_dir) == 0
    return run_dir


def _config(algo, kind, **changes):
    parts = {"critic.kind": kind, "critic.kappa": None, "policy.hidden": (8, 6)}
    config = small(algo).as_config().replace(**{**parts, "critic.hidden": (8, 6), **changes})
    return resolve(config)


CONFIGS = {
    **{kind: _config("dppo", kind) for kind in ("quantile", "ordered", "sorted")},
    "scalar": _config(
        "trpo",
        "scalar",
        **{"policy.covariance": "state", "policy.hidden": (8,), "num_seeds": 2},
        normalize_observations=False,
        normalize_rewards=False,
    ),
}
"""All critics, both covariances, with and without normalization, one seed and two."""


class Untrained(NamedTuple):
    """The file of a policy with random networks."""

    name: str
    config: dg.Config
    index: int
    file: str
    networks: checkpoint.Networks


@pytest.fixture(scope="session", params=CONFIGS)
def untrained(request, tmp_path_factory):
    """A policy with actions that reach the actuators' range, for each kind of critic."""
    return make_untrained(request.param, tmp_path_factory.mktemp("untrained"))


def make_untrained(name, directory):
    rng, config = np.random.default_rng(0), CONFIGS[name]
    blank = checkpoint._abstract_state(config)
    policy, critic = (
        jax.tree.map(lambda x: rng.normal(0, 0.5, x.shape).astype(x.dtype), each.params)
        for each in (blank.policy, blank.critic)
    )
    stats = jax.tree.map(lambda x: rng.uniform(0.5, 2, x.shape).astype(x.dtype), blank.obs_stats)
    file = directory / f"{name}.msgpack"
    states = InferenceState(policy, stats), InferenceState(critic, stats)
    networks = checkpoint.Networks(*states, file)
    checkpoint.save_networks(file, config, networks, np.full(config.num_seeds, 2.0))
    return Untrained(name, config, config.num_seeds - 1, file, networks)


@pytest.fixture(scope="session")
def opengl():
    """Return a backend that works here."""
    backend = next(filter(gl.works, gl.CANDIDATES), None)
    return backend or pytest.skip(f"neither {' nor '.join(gl.CANDIDATES)} works here")
