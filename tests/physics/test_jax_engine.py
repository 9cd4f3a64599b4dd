"""Our own stages: blocks of envs, the bound on contacts, and refusals."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dgae_jax.envs.gym_tasks import GYM_TASKS
from dgae_jax.envs.task import load_spec
from dgae_jax.physics.engine import Reads
from dgae_jax.physics.jax.collision import Geoms, contact_groups
from dgae_jax.physics.jax.forward import jax_engine
from dgae_jax.physics.jax.model import put_model
from tests.parity import FEET, reference


def falls(count):
    qpos, qvel = np.random.default_rng(0).uniform(-0.2, 0.2, (2, count, 2)).astype(np.float32)
    return jnp.asarray(qpos), jnp.asarray(qvel)


def test_blocks_and_nested_vmaps_move_as_each_env_alone():
    physics, (qpos, qvel) = jax_engine(FEET, 4, Reads()), falls(48)
    step = jax.vmap(lambda q, v: physics.step(physics.init(q, v), jnp.zeros(0)))
    many = [jnp.concatenate([x, x, x])[:-1] for x in (qpos, qvel)]  # two blocks, not full
    blocks, one = jax.jit(step)(*many), jax.jit(step)(qpos, qvel)
    nested = jax.jit(jax.vmap(step))(qpos.reshape(3, 16, 2), qvel.reshape(3, 16, 2))
    touching = (jnp.abs(one.qacc_warmstart - jnp.array([-9.81, 0])) > 1).any(1)
    assert touching.sum() > 12
    assert_allclose(blocks.qvel, jnp.concatenate([one.qvel] * 3)[:-1], atol=1e-5)
    assert_allclose(nested.qvel.reshape(48, 2), one.qvel, atol=1e-5)


def ground_bound(spec):
    """The contacts with the ground that are kept, and those that are possible."""
    groups = contact_groups(put_model(spec.compile()), spec.modelname)
    (ground,) = (group for group in groups if not isinstance(group.geom1, Geoms))
    return ground.max_contacts, len(ground.geom1)


@pytest.mark.parametrize("name", ["ant", "walker2d"])
def test_states_have_fewer_contacts_than_the_bound(name):
    bounds = {ground_bound(load_spec(file)) for file in GYM_TASKS[name].FILE.values()}
    assert bounds == ({(8, 25)} if name == "ant" else {(10, 14)})
    assert reference(name)[1].max() < 8


def test_model_of_a_known_name_with_other_geoms_has_no_bound():
    spec = load_spec("ant.xml")
    spec.body("torso").add_geom(size=[0.1, 0, 0])
    assert ground_bound(spec) == (26, 26)


def test_model_without_constraints_feels_no_forces():
    xml = """<mujoco><option integrator='RK4'/><worldbody><body name='b'><freejoint/>
      <geom size='.1' contype='0' conaffinity='0'/></body></worldbody></mujoco>"""
    physics = jax_engine(mujoco.MjSpec.from_string(xml), 3, Reads(xpos=True, cfrc_ext=True))
    state = physics.init(jnp.array([1.0, 2, 3, 1, 0, 0, 0]), jnp.zeros(6))
    after = jax.jit(physics.step)(state, jnp.zeros(0))
    assert_allclose(after.cfrc_ext, np.zeros((2, 6)))
    # free fall for 3 steps of 2 ms; read one substep late, at 2 of them: z = 3 - g t²/2
    assert_allclose(after.xpos, [[1, 2, 3 - 9.81 * 0.006**2 / 2]], rtol=1e-6)


PLANE, RK4 = "<geom type='plane' size='1 1 1'/>", "integrator='RK4'"
MOTOR = "<actuator><motor joint='a' gear='0 0 0 0 0 1'/></actuator>"


def model(joint="<joint/>", *, option=RK4, geom="", body="", more=""):
    """One body over a plane."""
    inside = f"{joint}<geom size='.1' {geom}/>{body}"
    tree = f"<worldbody>{PLANE}<body pos='0 0 1'>{inside}</body></worldbody>"
    return f"<mujoco><option {option}/>{tree}{more}</mujoco>"


@pytest.mark.parametrize(
    ("xml", "reason"),
    [
        (model(option=""), "integrator mjINT_EULER"),
        (model("<joint type='ball'/>"), "ball joints"),
        (model(option=f"{RK4} cone='elliptic'"), "elliptic friction cones"),
        (model("<joint frictionloss='1'/>"), "dof_frictionloss"),
        (model("<freejoint name='a'/>", more=MOTOR), "actuators other than motors at hinges"),
        (model(geom="solref='-9 -9'"), "contact softness"),
        (
            model().replace("</worldbody>", f"<body pos='1 0 0'>{PLANE}</body></worldbody>"),
            "more than one tree, colliding geoms other than",
        ),
        (model("<joint damping='1 2'/>"), "dof_dampingpoly"),
        (model(geom="friction='0 0 0'"), "contacts without"),
        (model("<joint limited='true' range='0 50' margin='26'/>"), "joint limits with margins"),
        (model(option=f"{RK4} density='1'", body="<body><site/></body>"), "bodies without mass"),
    ],
)
def test_uncovered_model_is_refused(xml, reason):
    with pytest.raises(ValueError, match=f"does not cover .*{reason}"):
        jax_engine(mujoco.MjSpec.from_string(xml), 1, Reads())
