"""Every engine against `mj_step` of C MuJoCo, over one control interval of each model."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.envs.gym_tasks import GYM_TASKS
from dgae_jax.physics.engine import PhysicsState
from tests.parity import UPSTREAM, WARP, errors, reference, stepped

MODELS = sorted(GYM_TASKS)
slow = pytest.mark.slow  # MJX compiles for half a minute to a minute per model


@pytest.mark.parametrize("name", MODELS)
def test_native_is_mj_step_bit_for_bit(name):
    got, want = stepped(name, "native"), reference(name)[0]
    for field in PhysicsState._fields:
        assert_array_equal(
            getattr(got, field), getattr(want, field).astype(np.float32), err_msg=field
        )


FLOAT32 = [
    *(("jax", name) for name in MODELS),
    pytest.param("mjx-warp", "hopper", marks=WARP),
    *(pytest.param("mjx-warp", name, marks=(WARP, slow)) for name in ("swimmer", "walker2d")),
    pytest.param("mjx-warp", "ant", marks=(WARP, slow, UPSTREAM)),
]


@pytest.mark.parametrize(("engine", "name"), FLOAT32)
def test_float32_control_interval_agrees_with_c(engine, name):
    got, want = stepped(name, engine), reference(name)[0]
    assert_allclose(got.qpos, want.qpos, atol=1e-4)
    assert_allclose(got.qvel, want.qvel, atol=1e-3)
    assert_allclose(got.xpos, want.xpos, atol=1e-4)
    assert_allclose(got.cfrc_ext, want.cfrc_ext, atol=1e-2, rtol=1e-3)


FLOAT64 = [
    *(("jax", name) for name in MODELS),
    *(pytest.param("mjx", name, marks=slow) for name in MODELS if name != "ant"),
    pytest.param("mjx", "ant", marks=(slow, UPSTREAM)),
]


@pytest.mark.parametrize(("engine", "name"), FLOAT64)
def test_float64_control_interval_differs_from_c_by_rounding(engine, name):
    error = errors(name, engine, x64=True)
    # C's solver stops at a tolerance, which Ant's light legs show
    assert np.quantile(error, 0.99) < 1e-7
    assert error.max() < (1e-4 if name == "ant" else 1e-9)
    got, want = stepped(name, engine, x64=True), reference(name)[0]
    assert_allclose(got.xpos, want.xpos, atol=1e-4 if name == "ant" else 1e-9)
    assert_allclose(got.cfrc_ext, want.cfrc_ext, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_states_have_contacts_where_a_model_has_any(name):
    contacts = reference(name)[1]
    assert contacts.max() == 0 if name == "swimmer" else (contacts > 0).mean() > 0.1
