"""A run shared by several devices is the run of one; a CPU poses as four in another process."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dgae_jax.learn import devices
from tests.helpers import ROOT


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    file = tmp_path_factory.mktemp("shared") / "runs.npz"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-m", "tests.learn.shared_run", file],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return np.load(file)


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize("algo", ["dppo", "dtrpo"])
def test_after_ten_iterations_the_networks_are_those_of_one_device_up_to_rounding(
    algo, count, found
):
    assert_allclose(found[f"{algo} {count}"], found[f"{algo} 1"], atol=1e-5)
    assert_allclose(found[f"{algo} {count} reward"], found[f"{algo} 1 reward"], atol=1e-5)
    assert np.abs(found[f"{algo} 1"] - found[f"{algo} start"]).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["dppo", "dtrpo"])
def test_devices_that_share_each_minibatch_as_accelerators_do_find_the_same(algo, found):
    assert_allclose(found[f"{algo} gradients"], found[f"{algo} 1"], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [4, 3])
def test_seeds_are_divided_between_devices_or_their_worlds_are_and_find_the_same(seeds, found):
    assert_allclose(found[f"{seeds} seeds 4"], found[f"{seeds} seeds 1"], atol=1e-5)


def test_a_device_alone_shares_with_nobody():
    assert devices.make_mesh(1) is None
    assert devices.count() == 1
    assert devices.divided(len, (0,), None) is len
