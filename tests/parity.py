"""States of the four models, and the steps of C MuJoCo and of the engines from them."""

import functools
import math
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dgae_jax.envs.gym_tasks import GYM_TASKS
from dgae_jax.envs.task import load_spec
from dgae_jax.physics.engine import PhysicsState, Reads
from dgae_jax.physics.registry import make_physics

COUNT = 128

WARP = pytest.mark.skipif(
    find_spec("warp") is None, reason="needs warp-lang: pip install 'dgae_jax[warp]'"
)
UPSTREAM = pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="MJX has another contact tangent than C (google-deepmind/mujoco#2774) and no RKMK",
)


FEET = mujoco.MjSpec.from_string("""
<mujoco><option integrator="RK4"/><worldbody><geom type="plane" size="9 9 1"/>
<body pos="0 0 .2"><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
<geom type="capsule" size=".1" fromto="-.3 0 0 .3 0 0"/></body></worldbody></mujoco>
""")
"""A capsule that falls on its two ends: quick to compile, with contacts."""


def model_of(name):
    return load_spec(GYM_TASKS[name].FILE["v4"]).compile()


def reads_of(name):
    return Reads(xpos=name == "ant", cfrc_ext=True)


@functools.cache
def states(name):
    """Poses under random and held controls, fallen ones included, in float32, with controls."""
    model, rng = model_of(name), np.random.default_rng(0)
    data, kept = mujoco.MjData(model), []
    while len(kept) < COUNT:
        if len(kept) % 32 == 0:
            mujoco.mj_resetData(model, data)
            data.qpos[:] += rng.uniform(-0.2, 0.2, model.nq)
            data.qvel[:] += rng.uniform(-1, 1, model.nv)
            held = rng.uniform(-1.2, 1.2, model.nu)
        ctrl = held if len(kept) % 64 < 32 else rng.uniform(-1.2, 1.2, model.nu)
        ctrl = ctrl.astype(np.float32)
        state = (data.qpos, data.qvel, data.qacc_warmstart)
        kept.append((*(x.astype(np.float32) for x in state), ctrl))
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, nstep=GYM_TASKS[name].FRAME_SKIP)
    return tuple(np.stack(x) for x in zip(*kept, strict=True))


@functools.cache
def reference(name):
    """The control interval by `mj_step`, read as Gymnasium reads it, and the contacts."""
    model = model_of(name)
    data, after, contacts = mujoco.MjData(model), [], []
    for qpos, qvel, warmstart, ctrl in zip(*states(name), strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        data.qacc_warmstart[:], data.ctrl[:] = warmstart, ctrl
        mujoco.mj_step(model, data, nstep=GYM_TASKS[name].FRAME_SKIP)
        mujoco.mj_rnePostConstraint(model, data)
        xpos = data.xpos[1:2] if name == "ant" else data.xpos[:0]
        fields = (data.qpos, data.qvel, data.qacc_warmstart, xpos, data.cfrc_ext)
        after.append([x.copy() for x in fields])
        contacts.append(data.ncon)
    return PhysicsState(*(np.stack(x) for x in zip(*after, strict=True))), np.array(contacts)


def start(physics, name, *shape):
    """The first states, with a batch of `shape`, and their controls."""
    fields = (x[: math.prod(shape)].reshape(*shape, -1) for x in states(name))
    qpos, qvel, warmstart, ctrl = (jnp.asarray(x, float) for x in fields)
    return physics.init(qpos, qvel)._replace(qacc_warmstart=warmstart), ctrl


@functools.cache
def stepped(name, engine, *, x64=False):
    """The control interval by an engine."""
    with jax.enable_x64(x64):
        spec, skip = load_spec(GYM_TASKS[name].FILE["v4"]), GYM_TASKS[name].FRAME_SKIP
        physics = make_physics(engine, spec, skip, reads_of(name))
        after = jax.jit(jax.vmap(physics.step))(*start(physics, name, COUNT))
        return jax.tree.map(np.asarray, after)


def errors(name, engine, *, x64=False):
    """The largest difference of positions and velocities from C's, per state."""
    got, want = stepped(name, engine, x64=x64), reference(name)[0]
    return np.maximum(np.abs(got.qpos - want.qpos).max(1), np.abs(got.qvel - want.qvel).max(1))
