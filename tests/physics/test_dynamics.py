import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dgae_jax.envs.task import load_spec
from dgae_jax.physics.jax import contacts, dynamics, spatial
from dgae_jax.physics.jax.scene import scene_of
from tests.helpers import GYM_TASKS

# a floating tree that uses what the four tasks do not: anchors off the origin, springs, a body without joints, any orientation
SPRINGY = """
<mujoco><option density="20" viscosity="0.3" gravity="1 -2 -9"/><worldbody><body pos="0 0 1"><freejoint/><geom type="box" size=".1 .2 .3"/>
  <body pos=".3 .1 .2" quat=".8 .2 -.4 .4"><joint axis="1 2 3" pos=".1 -.2 .05" stiffness="3" springref=".2" damping=".4" armature=".05"/>
    <geom type="capsule" size=".05 .2" quat=".5 .5 -.5 .5"/>
    <body pos="0 .1 .3" quat="1 1 0 .5"><geom size=".08"/>
      <body pos=".2 0 0"><joint type="slide" axis="0 1 -1" damping="1"/><geom type="box" size=".1 .05 .02" pos=".03 0 .1"/></body>
    </body></body></body></worldbody></mujoco>"""


def model_of(name):
    return (
        mujoco.MjModel.from_xml_string(SPRINGY)
        if name == "springy"
        else load_spec(GYM_TASKS[name].FILE["v4"]).compile()
    )


@functools.cache
def poses(name, count=40):
    """Positions on both sides of ground and limits, velocities, and controls beyond the motors' range; the world last."""
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
def test_every_quantity_of_the_tree_is_mujocos(name):
    model = model_of(name)
    with jax.enable_x64(True):
        tree = dynamics.tree_of(model)
        got = jax.jit(functools.partial(dynamics.smooth, tree))(*map(jnp.asarray, poses(name)))
        acceleration = spatial.solve(got.mass, got.force)
    for i, data in forwards(name):
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        assert_allclose(got.centre[..., i], data.subtree_com[1], atol=1e-12)
        assert_allclose(got.axes[..., i], data.cdof, atol=1e-12)
        assert_allclose(got.mass[..., i], mass, atol=1e-11)
        assert_allclose(got.force[..., i], data.qfrc_smooth, rtol=1e-10, atol=1e-10)
        assert_allclose(acceleration[..., i], data.qacc_smooth, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", sorted(GYM_TASKS))
def test_constraint_rows_are_mujocos(name):
    model = model_of(name)
    with jax.enable_x64(True):
        tree = dynamics.tree_of(model)
        scene = scene_of(tree)

        def rows(qpos, qvel, ctrl):
            return contacts.constrain(
                scene, tree, dynamics.smooth(tree, qpos, qvel, ctrl), qpos, qvel
            )[0]

        got = jax.jit(rows)(*map(jnp.asarray, poses(name)))
    seen = 0
    for i, data in forwards(name):
        active = np.asarray(got.stiffness[:, i]) > 0
        seen += data.nefc
        assert active.sum() == data.nefc
        ours = np.c_[
            got.jacobian[:, active, i].T,
            got.stiffness[active, i, None],
            got.reference[active, i, None],
        ]
        theirs = np.c_[
            data.efc_J.reshape(data.nefc, model.nv), data.efc_D[:, None], data.efc_aref[:, None]
        ]
        # the order of rows is ours; a fixed mix of the columns, which are all different, sorts both in the same way
        mix = np.random.default_rng(1).normal(size=ours.shape[1])
        assert_allclose(
            ours[np.argsort(ours @ mix)], theirs[np.argsort(theirs @ mix)], rtol=1e-7, atol=1e-8
        )
    assert seen > 10


def test_a_rotation_by_a_vector_is_mujocos():
    rng = np.random.default_rng(0)
    quats, vectors = rng.normal(size=(4, 30)), rng.normal(size=(3, 30))
    quats /= np.linalg.norm(quats, axis=0)
    vectors[:, 0] = 0
    with jax.enable_x64(True):
        got, matrices = (
            spatial.rotate(jnp.asarray(quats), jnp.asarray(vectors)),
            spatial.rotation(jnp.asarray(quats)),
        )
    for i in range(30):
        want = quats[:, i].copy()
        mujoco.mju_quatIntegrate(want, vectors[:, i], 1.0)
        assert_allclose(got[:, i], want, atol=1e-14)
        assert_allclose(matrices[..., i], dynamics.quat_matrix(quats[:, i]), atol=1e-14)


def test_small_systems_are_solved_as_numpy_solves_them():
    rng = np.random.default_rng(0)
    root, vector = rng.normal(size=(20, 7, 7)), rng.normal(size=(20, 7))
    matrix = root @ root.swapaxes(1, 2) + 0.1 * np.eye(7)
    with jax.enable_x64(True):
        got = spatial.solve(jnp.moveaxis(jnp.asarray(matrix), 0, -1), jnp.asarray(vector.T))
    assert_allclose(got.T, np.linalg.solve(matrix, vector[..., None])[..., 0], rtol=1e-8)
