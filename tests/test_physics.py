import functools
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.envs.gym_tasks import load_model
from dgae_jax.physics.base import at_pose
from dgae_jax.physics.mjx import mjx
from dgae_jax.physics.native import native

FRAME_SKIP = 4


@functools.cache
def states(count=128):
    """Hopper poses visited under random controls, fallen ones included, in float32, with a control for each."""
    model, rng = load_model("hopper.xml"), np.random.default_rng(0)
    data, kept = mujoco.MjData(model), []
    while len(kept) < count:
        if len(kept) % 16 == 0:
            mujoco.mj_resetData(model, data)
            data.qpos[:] += rng.uniform(-0.2, 0.2, model.nq)
            data.qvel[:] += rng.uniform(-1, 1, model.nv)
        ctrl = rng.uniform(-1.2, 1.2, model.nu).astype(np.float32)
        kept.append((data.qpos.astype(np.float32), data.qvel.astype(np.float32), data.qacc_warmstart.astype(np.float32), ctrl))
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, nstep=FRAME_SKIP)
    return tuple(jnp.asarray(np.stack(x)) for x in zip(*kept, strict=True))


@functools.cache
def reference():
    """The same control interval by `mj_step` on a single `mjData`."""
    model = load_model("hopper.xml")
    data, after = mujoco.MjData(model), []
    for qpos, qvel, warmstart, ctrl in zip(*map(np.asarray, states()), strict=True):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = qpos, qvel, warmstart, ctrl
        mujoco.mj_step(model, data, nstep=FRAME_SKIP)
        after.append((data.qpos.astype(np.float32), data.qvel.astype(np.float32), data.qacc_warmstart.astype(np.float32)))
    return tuple(np.stack(x) for x in zip(*after, strict=True))


def stepped(physics):
    qpos, qvel, warmstart, ctrl = states()
    state = at_pose(qpos, qvel)._replace(warmstart=warmstart)
    return jax.jit(jax.vmap(physics.step))(state, ctrl)


def test_native_is_mj_step_bit_for_bit():
    got = stepped(native(load_model("hopper.xml"), FRAME_SKIP))
    for ours, theirs in zip(got, reference(), strict=True):
        assert_array_equal(ours, theirs)


def test_native_gives_the_same_bits_through_nested_vmaps_and_alone():
    physics = native(load_model("hopper.xml"), FRAME_SKIP)
    qpos, qvel, warmstart, ctrl = (x[:12].reshape(3, 4, -1) for x in states())
    state = at_pose(qpos, qvel)._replace(warmstart=warmstart)
    nested = jax.jit(jax.vmap(jax.vmap(physics.step)))(state, ctrl)
    alone = jax.jit(physics.step)(jax.tree.map(lambda x: x[2, 1], state), ctrl[2, 1])
    assert_array_equal(nested.qpos.reshape(12, -1), reference()[0][:12])
    assert_array_equal(alone.qvel, nested.qvel[2, 1])


def test_native_lets_a_non_finite_state_be_seen():
    physics = native(load_model("hopper.xml"), FRAME_SKIP)
    qpos, qvel, _, ctrl = (x[:2] for x in states())
    after = jax.jit(jax.vmap(physics.step))(at_pose(qpos.at[0, 3].set(jnp.nan), qvel), ctrl)
    assert jnp.isnan(after.qpos[0]).any()
    assert jnp.isfinite(after.qpos[1]).all()


def test_mjx_agrees_with_c_mujoco_after_a_control_interval():
    got = stepped(mjx(load_model("hopper.xml"), FRAME_SKIP))
    assert_allclose(got.qpos, reference()[0], atol=1e-4)
    assert_allclose(got.qvel, reference()[1], atol=1e-3)


def test_states_reach_contacts_and_fallen_poses():
    model, (qpos, *_) = load_model("hopper.xml"), states()
    data, contacts = mujoco.MjData(model), []
    for q in np.asarray(qpos):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        contacts.append(data.ncon)
    assert np.mean(np.array(contacts) > 0) > 0.1
    assert (np.abs(qpos[:, 2]) > 0.2).sum() > 10


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        ("<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody><option integrator='RK4'/></mujoco>", "free or ball"),
        ("<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>", "RK4"),
    ],
)
def test_mjx_refuses_by_name_a_model_it_does_not_cover(model, reason):
    with pytest.raises(ValueError, match=reason):
        mjx(mujoco.MjModel.from_xml_string(model), 1)


def test_model_files_are_those_of_the_installed_gymnasium():
    assert find_spec("gymnasium") is not None
    assert load_model("hopper.xml").nq == 6
