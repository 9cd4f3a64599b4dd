"""MuJoCo MJX: how worlds are vmapped, and what is refused."""

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
from tests.parity import WARP, reference, states


@WARP
def test_warp_learns_the_number_of_worlds_from_the_vmap():
    physics, want = (
        make_physics("mjx-warp", load_spec("hopper.xml"), 4, Reads()),
        reference("hopper")[0],
    )
    qpos, qvel, warmstart, ctrl = (jnp.asarray(x) for x in states("hopper"))
    state = physics.at_pose(qpos, qvel)._replace(qacc_warmstart=warmstart)
    many = jax.jit(jax.vmap(physics.step))(state, ctrl)
    few = jax.jit(jax.vmap(physics.step))(*jax.tree.map(lambda x: x[:5], (state, ctrl)))
    grid = jax.tree.map(lambda x: x[:12].reshape(3, 4, *x.shape[1:]), (state, ctrl))
    nested = jax.jit(jax.vmap(jax.vmap(physics.step)))(*grid)
    alone = jax.jit(physics.step)(*jax.tree.map(lambda x: x[7], (state, ctrl)))
    assert_allclose(many.qvel, want.qvel, atol=1e-4)
    assert_allclose(few.qvel, want.qvel[:5], atol=1e-4)
    assert_allclose(nested.qvel.reshape(12, -1), want.qvel[:12], atol=1e-4)
    assert_allclose(alone.qvel, want.qvel[7], atol=1e-4)


@WARP
def test_warp_keeps_the_dtype_of_the_state_it_was_given():
    with jax.enable_x64(True):
        physics = make_physics("mjx-warp", load_spec("swimmer.xml"), 1, Reads())
        after = jax.eval_shape(
            physics.step, physics.at_pose(jnp.zeros(5), jnp.zeros(5)), jnp.zeros(2)
        )
    assert after.qpos.dtype == after.qvel.dtype == "float64"


@pytest.mark.parametrize("engine", ["mjx", pytest.param("mjx-warp", marks=WARP)])
def test_a_model_that_mjx_does_not_cover_is_refused_with_its_reason(engine):
    xml = "<mujoco><option solver='PGS'/><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    with pytest.raises(ValueError, match=rf"physics {engine} does not cover this model: .*PGS"):
        make_physics(engine, mujoco.MjSpec.from_string(xml), 1, Reads())


def test_the_models_numerics_which_mjx_misreads_are_left_out_of_a_copy():
    spec = load_spec("ant.xml")
    assert len(spec.numerics) == 1
    assert make_physics("mjx", spec, 5, Reads()).model.nnumeric == 0
    assert len(spec.numerics) == 1


@WARP
def test_warp_announces_neither_itself_nor_its_kernels():
    code = """
import jax, jax.numpy as jnp
from dgae_jax.envs.task import load_spec
from dgae_jax.physics.engine import Reads
from dgae_jax.physics.registry import make_physics
physics = make_physics("mjx-warp", load_spec("hopper.xml"), 4, Reads())
jax.block_until_ready(jax.jit(physics.step)(physics.at_pose(jnp.zeros(6), jnp.zeros(6)), jnp.zeros(3)))"""
    assert (
        subprocess.run(
            [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout
        == ""
    )
