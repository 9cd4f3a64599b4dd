"""States of the four models, what C MuJoCo makes of them, and the engines' answers: for the tests of engines."""

import functools
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dgae_jax.envs.task import load_spec
from dgae_jax.physics.engine import PhysicsState, Reads
from dgae_jax.physics.registry import make_physics
from tests.helpers import GYM_TASKS

COUNT = 128

WARP = pytest.mark.skipif(
    find_spec("warp") is None, reason="needs warp-lang: pip install 'dgae_jax[warp]'"
)
UPSTREAM = pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="MJX takes another contact tangent than C (google-deepmind/mujoco#2774) and has no RKMK correction of free joints in RK4",
)


def model_of(name):
    return load_spec(GYM_TASKS[name].FILE["v4"]).compile()


def reads_of(name):
    return Reads(("torso",) if name == "ant" else (), forces=True)


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
        ctrl = (held if len(kept) % 64 < 32 else rng.uniform(-1.2, 1.2, model.nu)).astype(
            np.float32
        )
        kept.append(
            (*(x.astype(np.float32) for x in (data.qpos, data.qvel, data.qacc_warmstart)), ctrl)
        )
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, nstep=GYM_TASKS[name].FRAME_SKIP)
    return tuple(np.stack(x) for x in zip(*kept, strict=True))


@functools.cache
def reference(name):
    """The same control interval by `mj_step` on a single `mjData`, read as Gymnasium reads it, and the number of contacts."""
    model = model_of(name)
    data, after, contacts = mujoco.MjData(model), [], []
    for qpos, qvel, warmstart, ctrl in zip(*states(name), strict=True):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = (
            qpos,
            qvel,
            warmstart,
            ctrl,
        )
        mujoco.mj_step(model, data, nstep=GYM_TASKS[name].FRAME_SKIP)
        mujoco.mj_rnePostConstraint(model, data)
        xpos = data.xpos[1:2] if name == "ant" else data.xpos[:0]
        after.append(
            [x.copy() for x in (data.qpos, data.qvel, data.qacc_warmstart, xpos, data.cfrc_ext)]
        )
        contacts.append(data.ncon)
    return PhysicsState(*(np.stack(x) for x in zip(*after, strict=True))), np.array(contacts)


@functools.cache
def stepped(name, engine, *, x64=False):
    """What an engine makes of the states."""
    with jax.enable_x64(x64):
        physics = make_physics(
            engine,
            load_spec(GYM_TASKS[name].FILE["v4"]),
            GYM_TASKS[name].FRAME_SKIP,
            reads_of(name),
        )
        qpos, qvel, warmstart, ctrl = (
            jnp.asarray(x, float if x64 else jnp.float32) for x in states(name)
        )
        state = physics.at_pose(qpos, qvel)._replace(qacc_warmstart=warmstart)
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(physics.step))(state, ctrl))


def errors(name, engine, *, x64=False):
    """The largest difference of positions and velocities from C's, per state."""
    got, want = stepped(name, engine, x64=x64), reference(name)[0]
    return np.maximum(np.abs(got.qpos - want.qpos).max(1), np.abs(got.qvel - want.qvel).max(1))
