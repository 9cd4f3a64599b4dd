"""A run shared by several devices is the run of one; a CPU poses as four in another process."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import dgae_jax as dg
from dgae_jax.learn import devices
from dgae_jax.learn.build import seed_keys
from dgae_jax.learn.parallel import make_trainer
from tests.helpers import ROOT, small


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    file = tmp_path_factory.mktemp("shared") / "runs.npz"
    program = [sys.executable, "-m", "tests.learn.test_devices", file]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    subprocess.run(program, cwd=ROOT, env=environment, check=True, timeout=300)
    return np.load(file)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shared", "single"),
    [
        *((f"{algo} 1 {count}", f"{algo} 1 1") for algo in ("dppo", "dtrpo") for count in (2, 4)),
        ("dppo gradients", "dppo 1 1"),  # each minibatch is shared, as on accelerators
        ("dtrpo gradients", "dtrpo 1 1"),
        ("dppo 4 4", "dppo 4 1"),  # seeds are divided
        ("dppo 3 4", "dppo 3 1"),  # seeds do not divide, and envs are
    ],
)
def test_shared_runs_are_those_of_one_device_up_to_rounding(shared, single, found):
    assert_allclose(found[shared], found[single], atol=1e-5)
    if single == "dppo 1 1":
        assert np.abs(found[single] - found["dppo start"]).max() > 1e-3


def trained(algo, seeds, count, iterations=10):
    """Parameters after ten iterations and their rewards, on so many devices."""
    config = dg.resolve(small(algo, num_envs=8, num_steps=16, num_seeds=seeds))
    env = dg.make_env("hopper", physics="native")
    trainer = make_trainer(env, 10, devices.make_mesh(count))
    state = trainer.init(config, seed_keys(config))
    state, rows = trainer.dispatch(config, state, iterations)
    assert len(state.episodes.total.sharding.device_set) == count
    numbers = state.policy.params, state.critic.params, rows["reward"]
    return np.concatenate([x.ravel() for x in jax.tree.leaves(numbers)])


def main(file):
    devices.divide_cpu(4)
    found = {"dppo start": trained("dppo", 1, 1, iterations=0)}
    runs = [(algo, 1, count) for algo in ("dppo", "dtrpo") for count in (1, 2, 4)]
    for run in [*runs, ("dppo", 4, 1), ("dppo", 4, 4), ("dppo", 3, 1), ("dppo", 3, 4)]:
        found["{} {} {}".format(*run)] = trained(*run)
    devices.concurrently = lambda *tasks: tuple(f(*args) for f, args in tasks)  # as accelerators
    for algo in ("dppo", "dtrpo"):
        found[f"{algo} gradients"] = trained(algo, 1, 4)
    np.savez(file, **found)


if __name__ == "__main__":
    main(sys.argv[1])
