import functools
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.envs.registry import TASKS
from dgae_jax.envs.task import load_spec
from dgae_jax.physics.engine import PhysicsState, has_free_root
from dgae_jax.physics.jax.engine import jax_engine
from dgae_jax.physics.native import native

MODELS = sorted(TASKS)
COUNT = 128


def model_of(name):
    return load_spec(TASKS[name].FILE["v4"]).compile()


@functools.cache
def states(name):
    """Poses under random and held controls from random starts, fallen ones included, in float32, with a control for each."""
    model, rng = model_of(name), np.random.default_rng(0)
    data, kept = mujoco.MjData(model), []
    while len(kept) < COUNT:
        if len(kept) % 32 == 0:
            mujoco.mj_resetData(model, data)
            data.qpos[:] += rng.uniform(-0.2, 0.2, model.nq)
            data.qvel[:] += rng.uniform(-1, 1, model.nv)
            held = rng.uniform(-1.2, 1.2, model.nu)
        ctrl = (held if len(kept) % 64 < 32 else rng.uniform(-1.2, 1.2, model.nu)).astype(np.float32)
        kept.append((*(x.astype(np.float32) for x in (data.qpos, data.qvel, data.qacc_warmstart)), ctrl))
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, nstep=TASKS[name].FRAME_SKIP)
    return tuple(np.stack(x) for x in zip(*kept, strict=True))


@functools.cache
def reference(name):
    """The same control interval by `mj_step` on a single `mjData`, read as Gymnasium reads it."""
    model = model_of(name)
    data, after, contacts = mujoco.MjData(model), [], []
    for qpos, qvel, warmstart, ctrl in zip(*states(name), strict=True):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = qpos, qvel, warmstart, ctrl
        mujoco.mj_step(model, data, nstep=TASKS[name].FRAME_SKIP)
        mujoco.mj_rnePostConstraint(model, data)
        torso = data.xpos[1] if has_free_root(model) else data.xpos[1, :0]
        after.append([x.copy() for x in (data.qpos, data.qvel, data.qacc_warmstart, torso, data.cfrc_ext)])
        contacts.append(data.ncon)
    return PhysicsState(*(np.stack(x).astype(np.float32) for x in zip(*after, strict=True))), np.array(contacts)


@functools.cache
def stepped(name, engine):
    physics = engine(load_spec(TASKS[name].FILE["v4"]), TASKS[name].FRAME_SKIP, contact_forces=True, max_contacts=TASKS[name].CONTACTS)
    qpos, qvel, warmstart, ctrl = map(jnp.asarray, states(name))
    state = physics.at_pose(qpos, qvel)._replace(warmstart=warmstart)
    return jax.jit(jax.vmap(physics.step))(state, ctrl)


@pytest.mark.parametrize("name", MODELS)
def test_native_is_mj_step_bit_for_bit(name):
    got, want = stepped(name, native), reference(name)[0]
    for field in PhysicsState._fields:
        assert_array_equal(getattr(got, field), getattr(want, field), err_msg=field)


def test_native_gives_the_same_bits_through_nested_vmaps_and_alone():
    physics, want = native(load_spec("hopper.xml"), 4), reference("hopper")[0]
    qpos, qvel, warmstart, ctrl = (jnp.asarray(x[:12]).reshape(3, 4, -1) for x in states("hopper"))
    state = physics.at_pose(qpos, qvel)._replace(warmstart=warmstart)
    nested = jax.jit(jax.vmap(jax.vmap(physics.step)))(state, ctrl)
    alone = jax.jit(physics.step)(jax.tree.map(lambda x: x[2, 1], state), ctrl[2, 1])
    assert_array_equal(nested.qpos.reshape(12, -1), want.qpos[:12])
    assert_array_equal(alone.qvel, nested.qvel[2, 1])


def test_native_lets_a_non_finite_state_be_seen():
    physics = native(load_spec("hopper.xml"), 4)
    qpos, qvel, _, ctrl = (jnp.asarray(x[:2]) for x in states("hopper"))
    after = jax.jit(jax.vmap(physics.step))(physics.at_pose(qpos.at[0, 3].set(jnp.nan), qvel), ctrl)
    assert jnp.isnan(after.qpos[0]).any()
    assert jnp.isfinite(after.qpos[1]).all()


@pytest.mark.parametrize("name", MODELS)
def test_jax_agrees_with_c_mujoco_after_a_control_interval(name):
    got, want = stepped(name, jax_engine), reference(name)[0]
    assert_allclose(got.qpos, want.qpos, atol=1e-4)
    assert_allclose(got.qvel, want.qvel, atol=1e-3)
    assert_allclose(got.torso, want.torso, atol=1e-4)
    assert_allclose(got.contact, want.contact, atol=1e-2, rtol=1e-3)


@pytest.mark.parametrize("name", MODELS)
def test_in_float64_jax_differs_from_c_mujoco_by_rounding(name):
    with jax.enable_x64(True):
        physics = jax_engine(load_spec(TASKS[name].FILE["v4"]), TASKS[name].FRAME_SKIP, max_contacts=TASKS[name].CONTACTS)
        qpos, qvel, warmstart, ctrl = (jnp.asarray(x.astype(float)) for x in states(name))
        got = jax.jit(jax.vmap(physics.step))(physics.at_pose(qpos, qvel)._replace(warmstart=warmstart), ctrl)
    got, model = jax.tree.map(np.asarray, got), model_of(name)
    data, errors = mujoco.MjData(model), []
    for i, (qpos, qvel, warmstart, ctrl) in enumerate(zip(*states(name), strict=True)):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = qpos, qvel, warmstart, ctrl
        mujoco.mj_step(model, data, nstep=TASKS[name].FRAME_SKIP)
        errors.append(max(np.abs(data.qpos - got.qpos[i]).max(), np.abs(data.qvel - got.qvel[i]).max()))
    # C's solver stops at a tolerance, which Ant's light legs show
    assert np.quantile(errors, 0.99) < 1e-7
    assert max(errors) < (1e-4 if name == "ant" else 1e-9)


def test_worlds_in_blocks_and_under_nested_vmaps_move_as_each_alone():
    physics, (qpos, qvel, _, ctrl) = jax_engine(load_spec("hopper.xml"), 4), map(jnp.asarray, states("hopper"))
    many = [jnp.concatenate([x, x, x])[:-1] for x in (qpos, qvel, ctrl)]  # three blocks, the last not full
    step = jax.jit(jax.vmap(lambda q, v, u: physics.step(physics.at_pose(q, v), u)))
    blocks, one = step(*many), step(qpos, qvel, ctrl)
    nested = jax.jit(jax.vmap(jax.vmap(lambda q, v: physics.step(physics.at_pose(q, v), ctrl[0]))))
    assert_allclose(blocks.qvel, jnp.concatenate([one.qvel] * 3)[:-1], atol=1e-5)
    folded = nested(qpos.reshape(8, 16, -1), qvel.reshape(8, 16, -1)).qvel.reshape(COUNT, -1)
    assert_allclose(folded, step(qpos, qvel, jnp.broadcast_to(ctrl[0], ctrl.shape)).qvel, atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_the_states_reach_contacts_and_never_more_than_the_limit(name):
    contacts, limit = reference(name)[1], TASKS[name].CONTACTS
    if limit is None:
        assert contacts.max() == 0
    else:
        assert (contacts > 0).mean() > 0.1
        assert contacts.max() < limit


def test_a_contact_limit_that_is_reached_would_be_seen():
    loose, tight = (jax_engine(load_spec("ant.xml"), 5, max_contacts=n) for n in (8, 1))
    qpos, qvel, _, ctrl = (jnp.asarray(x) for x in states("ant"))
    many = reference("ant")[1] > 1
    a, b = (jax.jit(jax.vmap(p.step))(p.at_pose(qpos[many], qvel[many]), ctrl[many]) for p in (loose, tight))
    assert float(jnp.abs(a.qvel - b.qvel).max()) > 0.1


def test_ant_stands_in_jax_although_its_model_has_another_numeric():
    physics = jax_engine(load_spec("ant.xml"), 5, max_contacts=8)
    state = physics.at_pose(jnp.asarray(physics.model.qpos0), jnp.zeros(physics.model.nv))
    state = jax.jit(lambda s: jax.lax.scan(lambda s, _: (physics.step(s, jnp.zeros(8)), None), s, None, length=100)[0])(state)
    assert float(state.qpos[2]) > 0.3


_BODY = "<worldbody><geom type='plane' size='1 1 1'/><body pos='0 0 1'>{}<geom size='.1'/></body></worldbody>"


@pytest.mark.parametrize(
    ("xml", "reason"),
    [
        (_BODY.format("<joint/>"), "integrator mjINT_EULER"),
        ("<option integrator='RK4'/>" + _BODY.format("<joint type='ball'/>"), "ball joints"),
        ("<option integrator='RK4' cone='elliptic'/>" + _BODY.format("<joint/>"), "elliptic friction cones"),
        ("<option integrator='RK4'/>" + _BODY.format("<joint frictionloss='1'/>"), "friction loss"),
        (
            "<option integrator='RK4'/>" + _BODY.format("<joint name='a'/>") + "<equality><joint joint1='a'/></equality>",
            "equality constraints",
        ),
        (
            "<option integrator='RK4'/>"
            + _BODY.format("<freejoint name='a'/>")
            + "<actuator><motor joint='a' gear='0 0 0 0 0 1'/></actuator>",
            "actuators other than motors at hinges",
        ),
        ("<option integrator='RK4'/>" + _BODY.format("<joint/>").replace("size='.1'", "size='.1' solref='-9 -9'"), "contact softness"),
        (
            "<option integrator='RK4'/><worldbody><body pos='1 0 0'><geom type='plane' size='1 1 1'/></body><body><joint/>"
            "<geom size='.1'/></body></worldbody>",
            "more than one tree, colliding geoms other than",
        ),
        ("<option integrator='RK4'/>" + _BODY.format("<joint damping='1 2'/>"), "dof dampingpoly"),
    ],
)
def test_jax_refuses_by_name_a_model_it_does_not_cover(xml, reason):
    with pytest.raises(ValueError, match=f"does not cover .*{reason}"):
        jax_engine(mujoco.MjSpec.from_string(f"<mujoco>{xml}</mujoco>"), 1)


def test_model_files_are_those_of_the_installed_gymnasium():
    assert find_spec("gymnasium") is not None
    assert load_spec("hopper.xml").compile().nq == 6
