"""MuJoCo MJX: agreement with C, vmapping, refusals."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import pytest
from numpy.testing import assert_allclose

from dgae_jax.envs.task import load_spec
from dgae_jax.physics.engine import Reads
from dgae_jax.physics.registry import make_physics
from tests.helpers import ROOT
from tests.parity import FEET, WARP, reference, start


def test_a_capsule_on_the_ground_moves_as_in_c():
    spec, model = FEET.copy(), FEET.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = -0.12, 0.2
    with jax.enable_x64(True):
        physics = make_physics("mjx", spec, 3, Reads())
        state = physics.init(jnp.asarray(data.qpos), jnp.zeros(2))
        after = jax.jit(physics.step)(state, jnp.zeros(0))
    mujoco.mj_step(model, data, nstep=3)
    assert data.ncon > 0
    assert_allclose(after.qvel, data.qvel, atol=1e-9)


@WARP
def test_warp_steps_any_nesting_of_vmaps():
    physics = make_physics("mjx-warp", load_spec("hopper.xml"), 4, Reads())
    want, (state, ctrl) = reference("hopper")[0], start(physics, "hopper", 128)
    many = jax.jit(jax.vmap(physics.step))(state, ctrl)
    grid = jax.tree.map(lambda x: x[:12].reshape(3, 4, *x.shape[1:]), (state, ctrl))
    nested = jax.jit(jax.vmap(jax.vmap(physics.step)))(*grid)
    alone = jax.jit(physics.step)(*jax.tree.map(lambda x: x[7], (state, ctrl)))
    assert_allclose(many.qvel, want.qvel, atol=1e-4)
    assert_allclose(nested.qvel.reshape(12, -1), want.qvel[:12], atol=1e-4)
    assert_allclose(alone.qvel, want.qvel[7], atol=1e-4)


@WARP
def test_warp_keeps_the_dtype_of_the_state():
    with jax.enable_x64(True):
        physics = make_physics("mjx-warp", load_spec("swimmer.xml"), 1, Reads())
        after = jax.eval_shape(physics.step, physics.init(jnp.zeros(5), jnp.zeros(5)), jnp.zeros(2))
    assert after.qpos.dtype == after.qvel.dtype == "float64"


@pytest.mark.parametrize("engine", ["mjx", pytest.param("mjx-warp", marks=WARP)])
def test_model_that_mjx_does_not_cover_is_refused(engine):
    spec = FEET.copy()
    spec.option.solver = mujoco.mjtSolver.mjSOL_PGS
    with pytest.raises(ValueError, match=rf"physics {engine} does not cover this model: .*PGS"):
        make_physics(engine, spec, 1, Reads())


def test_numerics_are_left_out_of_a_copy():
    spec = load_spec("ant.xml")
    assert len(spec.numerics) == 1
    assert make_physics("mjx", spec, 5, Reads()).model.nnumeric == 0
    assert len(spec.numerics) == 1


@WARP
def test_warp_prints_nothing():
    code = """
import jax, dgae_jax as dg
env = dg.make_env("hopper", physics="mjx-warp")
jax.block_until_ready(jax.jit(env.step)(env.reset(jax.random.key(0)), jax.numpy.zeros(3)))"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == ""
