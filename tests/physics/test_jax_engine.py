"""Our own stages: worlds in blocks, the bound on contacts, and what is refused."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dgae_jax.envs.task import load_spec
from dgae_jax.physics.engine import Reads
from dgae_jax.physics.jax.engine import jax_engine
from dgae_jax.physics.jax.scene import known_bound
from tests.helpers import GYM_TASKS
from tests.parity import model_of, reference

FEET = mujoco.MjSpec.from_string("""
<mujoco><option integrator="RK4"/><worldbody><geom type="plane" size="9 9 1"/>
<body pos="0 0 .2"><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
<geom type="capsule" size=".1" fromto="-.3 0 0 .3 0 0"/></body></worldbody></mujoco>
""")
"""A capsule that falls on its two ends: quick to compile, with contacts."""


def linear_schedule(count):
    qpos, qvel = np.random.default_rng(0).uniform(-0.2, 0.2, (2, count, 2)).astype(np.float32)
    return jnp.asarray(qpos), jnp.asarray(qvel)


def test_worlds_in_blocks_and_under_nested_vmaps_move_as_each_alone():
    physics, (qpos, qvel) = jax_engine(FEET, 4, Reads()), linear_schedule(48)
    step = jax.vmap(lambda q, v: physics.step(physics.at_pose(q, v), jnp.zeros(0)))
    many = [
        jnp.concatenate([x, x, x])[:-1] for x in (qpos, qvel)
    ]  # three blocks, the last not full
    blocks, one = jax.jit(step)(*many), jax.jit(step)(qpos, qvel)
    nested = jax.jit(jax.vmap(step))(qpos.reshape(3, 16, 2), qvel.reshape(3, 16, 2))
    assert (jnp.abs(one.qacc_warmstart - jnp.array([-9.81, 0])) > 1).any(
        1
    ).sum() > 12  # touch the ground
    assert_allclose(blocks.qvel, jnp.concatenate([one.qvel] * 3)[:-1], atol=1e-5)
    assert_allclose(nested.qvel.reshape(48, 2), one.qvel, atol=1e-5)


@pytest.mark.parametrize(
    ("file", "bound"),
    [("ant.xml", 8), ("walker2d.xml", 10), ("walker2d_v5.xml", 10), ("hopper.xml", None)],
)
def test_the_bound_on_contacts_is_known_for_the_models_that_have_more_than_ever_touch(file, bound):
    spec = load_spec(file)
    assert known_bound(spec.modelname, spec.compile()) == bound


@pytest.mark.parametrize("name", sorted(GYM_TASKS))
def test_no_state_has_as_many_contacts_as_the_bound(name):
    bound = known_bound(name, model_of(name))
    assert bound is None or reference(name)[1].max() < bound


def test_a_model_of_a_known_name_but_of_other_geoms_keeps_all_its_contacts():
    spec = load_spec("ant.xml")
    spec.body("torso").add_geom(size=[0.1, 0, 0])
    assert known_bound(spec.modelname, spec.compile()) is None


def test_a_bound_that_is_reached_would_be_seen():
    qpos, qvel = linear_schedule(48)
    loose, tight = (jax_engine(FEET, 5, Reads(), max_contacts=n) for n in (2, 1))
    a, b = (
        jax.jit(jax.vmap(lambda q, v, p=p: p.step(p.at_pose(q, v), jnp.zeros(0))))(
            qpos.at[:, 1].set(0), qvel
        )
        for p in (loose, tight)
    )
    assert float(jnp.abs(a.qvel - b.qvel).max()) > 0.1


def test_a_model_without_constraints_feels_no_forces():
    xml = "<option integrator='RK4'/><worldbody><body name='b'><freejoint/><geom size='.1' contype='0' conaffinity='0'/></body></worldbody>"
    physics = jax_engine(
        mujoco.MjSpec.from_string(f"<mujoco>{xml}</mujoco>"), 3, Reads(("b",), forces=True)
    )
    after = jax.jit(physics.step)(
        physics.at_pose(jnp.array([1.0, 2, 3, 1, 0, 0, 0]), jnp.zeros(6)), jnp.zeros(0)
    )
    assert_allclose(after.cfrc_ext, np.zeros((2, 6)))
    # linear_schedule for 3 steps of 2 ms; read one substep late, at 2 of them: z = 3 - g t²/2
    assert_allclose(after.xpos, [[1, 2, 3 - 9.81 * 0.006**2 / 2]], rtol=1e-6)


_BODY = "<worldbody><geom type='plane' size='1 1 1'/><body pos='0 0 1'>{}<geom size='.1'/></body></worldbody>"


@pytest.mark.parametrize(
    ("xml", "reason"),
    [
        (_BODY.format("<joint/>"), "integrator mjINT_EULER"),
        ("<option integrator='RK4'/>" + _BODY.format("<joint type='ball'/>"), "ball joints"),
        (
            "<option integrator='RK4' cone='elliptic'/>" + _BODY.format("<joint/>"),
            "elliptic friction cones",
        ),
        ("<option integrator='RK4'/>" + _BODY.format("<joint frictionloss='1'/>"), "friction loss"),
        (
            "<option integrator='RK4'/>"
            + _BODY.format("<joint name='a'/>")
            + "<equality><joint joint1='a'/></equality>",
            "equality constraints",
        ),
        (
            "<option integrator='RK4'/>"
            + _BODY.format("<freejoint name='a'/>")
            + "<actuator><motor joint='a' gear='0 0 0 0 0 1'/></actuator>",
            "actuators other than motors at hinges",
        ),
        (
            "<option integrator='RK4'/>"
            + _BODY.format("<joint/>").replace("size='.1'", "size='.1' solref='-9 -9'"),
            "contact softness",
        ),
        (
            "<option integrator='RK4'/><worldbody><body pos='1 0 0'><geom type='plane' size='1 1 1'/></body><body><joint/>"
            "<geom size='.1'/></body></worldbody>",
            "more than one tree, colliding geoms other than",
        ),
        ("<option integrator='RK4'/>" + _BODY.format("<joint damping='1 2'/>"), "dof dampingpoly"),
        (
            "<option integrator='RK4'/>"
            + _BODY.format("<joint/>").replace("size='.1'", "size='.1' friction='0 0 0'"),
            "contacts without",
        ),
        (
            "<option integrator='RK4'/>"
            + _BODY.format("<joint limited='true' range='0 50' margin='26'/>"),
            "joint limits with margins",
        ),
        (
            "<option integrator='RK4' density='1'/>" + _BODY.format("<joint/><body><site/></body>"),
            "bodies without mass in a fluid",
        ),
    ],
)
def test_a_model_that_is_not_covered_is_refused_by_name(xml, reason):
    with pytest.raises(ValueError, match=f"does not cover .*{reason}"):
        jax_engine(mujoco.MjSpec.from_string(f"<mujoco>{xml}</mujoco>"), 1, Reads())
