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
from dgae_jax.physics.jax.collision import known_max_contacts
from dgae_jax.physics.jax.forward import jax_engine
from tests.parity import FEET, model_of, reference


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


def test_models_with_many_possible_contacts_have_a_bound():
    bounds = {"ant.xml": 8, "walker2d.xml": 10, "walker2d_v5.xml": 10, "hopper.xml": None}
    for file, bound in bounds.items():
        spec = load_spec(file)
        assert known_max_contacts(spec.modelname, spec.compile()) == bound


@pytest.mark.parametrize("name", sorted(GYM_TASKS))
def test_states_have_fewer_contacts_than_the_bound(name):
    bound = known_max_contacts(name, model_of(name))
    assert bound is None or reference(name)[1].max() < bound


def test_model_of_a_known_name_with_other_geoms_has_no_bound():
    spec = load_spec("ant.xml")
    spec.body("torso").add_geom(size=[0.1, 0, 0])
    assert known_max_contacts(spec.modelname, spec.compile()) is None


def test_a_bound_that_is_reached_changes_the_motion():
    qpos, qvel = falls(48)
    loose, tight = (jax_engine(FEET, 5, Reads(), max_contacts=n) for n in (2, 1))
    state = loose.init(qpos.at[:, 1].set(0), qvel)
    a, b = (jax.jit(jax.vmap(p.step))(state, jnp.zeros((48, 0))) for p in (loose, tight))
    assert float(jnp.abs(a.qvel - b.qvel).max()) > 0.1


def test_model_without_constraints_feels_no_forces():
    xml = """<mujoco><option integrator='RK4'/><worldbody><body name='b'><freejoint/>
      <geom size='.1' contype='0' conaffinity='0'/></body></worldbody></mujoco>"""
    physics = jax_engine(mujoco.MjSpec.from_string(xml), 3, Reads(("b",), forces=True))
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
        (model("<joint frictionloss='1'/>"), "friction loss"),
        (model("<freejoint name='a'/>", more=MOTOR), "actuators other than motors at hinges"),
        (model(geom="solref='-9 -9'"), "contact softness"),
        (
            model().replace("</worldbody>", f"<body pos='1 0 0'>{PLANE}</body></worldbody>"),
            "more than one tree, colliding geoms other than",
        ),
        (model("<joint damping='1 2'/>"), "dof dampingpoly"),
        (model(geom="friction='0 0 0'"), "contacts without"),
        (model("<joint limited='true' range='0 50' margin='26'/>"), "joint limits with margins"),
        (model(option=f"{RK4} density='1'", body="<body><site/></body>"), "bodies without mass"),
    ],
)
def test_uncovered_model_is_refused(xml, reason):
    with pytest.raises(ValueError, match=f"does not cover .*{reason}"):
        jax_engine(mujoco.MjSpec.from_string(xml), 1, Reads())
