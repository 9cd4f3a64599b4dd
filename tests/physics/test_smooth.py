import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dgae_jax.envs.gym_tasks import GYM_TASKS
from dgae_jax.physics.jax import math
from dgae_jax.physics.jax.collision import collision, contact_groups
from dgae_jax.physics.jax.constraint import make_constraint
from dgae_jax.physics.jax.model import put_model
from dgae_jax.physics.jax.smooth import smooth
from tests import parity

# beyond the four tasks: anchors off the origin, springs, a body without joints, any orientation
SPRINGY = """
<mujoco><option integrator="RK4" density="20" viscosity="0.3" gravity="1 -2 -9"/>
  <default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body pos="0 0 1"><freejoint/><geom type="box" size=".1 .2 .3"/>
  <body pos=".3 .1 .2" quat=".8 .2 -.4 .4">
    <joint axis="1 2 3" pos=".1 -.2 .05" stiffness="3" springref=".2" damping=".4" armature=".05"/>
    <geom type="capsule" size=".05 .2" quat=".5 .5 -.5 .5"/>
    <body pos="0 .1 .3" quat="1 1 0 .5"><geom size=".08"/>
      <body pos=".2 0 0"><joint type="slide" axis="0 1 -1" damping="1"/>
        <geom type="box" size=".1 .05 .02" pos=".03 0 .1"/></body>
    </body></body></body></worldbody></mujoco>"""


def model_of(name):
    if name == "springy":
        return mujoco.MjModel.from_xml_string(SPRINGY)
    return parity.model_of(name)


@functools.cache
def poses(name, count=40):
    """Positions on both sides of ground and limits, velocities, controls; the env axis last."""
    model, rng = model_of(name), np.random.default_rng(0)
    qpos = model.qpos0[:, None] + rng.uniform(-2, 2, (model.nq, count))
    if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        qpos[3:7] /= np.linalg.norm(qpos[3:7], axis=0)
    return qpos, rng.normal(size=(model.nv, count)), rng.uniform(-1.5, 1.5, (model.nu, count))


def forwards(name):
    model = model_of(name)
    data = mujoco.MjData(model)
    for i, (qpos, qvel, ctrl) in enumerate(zip(*(x.T for x in poses(name)), strict=True)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_forward(model, data)
        yield i, data


@pytest.mark.parametrize("name", [*sorted(GYM_TASKS), "springy"])
def test_quantities_of_the_tree_are_mujocos(name):
    model = model_of(name)
    with jax.enable_x64(True):
        got = jax.jit(functools.partial(smooth, put_model(model)))(*map(jnp.asarray, poses(name)))
        qacc_smooth = math.solve(got.qM, got.qfrc_smooth)
    for i, data in forwards(name):
        qM = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, qM)
        assert_allclose(got.subtree_com[..., i], data.subtree_com[1], atol=1e-12)
        assert_allclose(got.cdof[..., i], data.cdof, atol=1e-12)
        assert_allclose(got.qM[..., i], qM, atol=1e-11)
        assert_allclose(got.qfrc_smooth[..., i], data.qfrc_smooth, rtol=1e-10, atol=1e-10)
        assert_allclose(qacc_smooth[..., i], data.qacc_smooth, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", sorted(GYM_TASKS))
def test_constraint_rows_are_mujocos(name):
    model = model_of(name)
    m = put_model(model)
    groups = contact_groups(m, "")  # without the bound of a known model

    def rows(qpos, qvel, ctrl):
        s = smooth(m, qpos, qvel, ctrl)
        return make_constraint(m, collision(groups, s.frames), s, qpos, qvel)

    with jax.enable_x64(True):
        got = jax.jit(rows)(*map(jnp.asarray, poses(name)))
    seen = 0
    for i, data in forwards(name):
        active = np.asarray(got.efc_D[:, i]) > 0
        seen += data.nefc
        assert active.sum() == data.nefc
        ours = np.c_[got.efc_J[:, active, i].T, got.efc_D[active, i], got.efc_aref[active, i]]
        theirs = np.c_[data.efc_J.reshape(data.nefc, model.nv), data.efc_D, data.efc_aref]
        # the order of rows is ours; a fixed mix of the columns sorts both in the same way
        mix = np.random.default_rng(1).normal(size=ours.shape[1])
        ours, theirs = (x[np.argsort(x @ mix)] for x in (ours, theirs))
        assert_allclose(ours, theirs, rtol=1e-7, atol=1e-8)
    assert seen > 10
