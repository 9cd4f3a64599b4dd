"""The physics for accelerators: the same solution in few turns of loops."""

import pytest
from numpy.testing import assert_allclose

from benchmarks.turns import of_step
from tests.parity import reference, stepped


@pytest.mark.parametrize("name", ["hopper", pytest.param("ant", marks=pytest.mark.slow)])
def test_accelerator_form_agrees_with_c_mujoco(name, elsewhere):
    got, want = stepped.__wrapped__(name, "jax"), reference(name)[0]
    assert_allclose(got.qpos, want.qpos, atol=1e-4)
    assert_allclose(got.qvel, want.qvel, atol=1e-3)
    assert_allclose(got.cfrc_ext, want.cfrc_ext, atol=1e-2, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("hopper", 150), ("ant", 400)])
def test_an_environment_step_turns_few_loops(name, most):
    assert sum(of_step(name, 256, 1)) < most
