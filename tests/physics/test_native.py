"""C MuJoCo inside jitted programs: batches of any shape, non-finite states, and its warnings."""

import logging
from collections import Counter

import jax
import jax.numpy as jnp
import mujoco
import pytest
from numpy.testing import assert_array_equal

from dgae_jax.envs.task import load_spec
from dgae_jax.physics import quiet
from dgae_jax.physics.engine import Reads
from dgae_jax.physics.native import _Host, native
from tests.parity import reference, states


def test_the_same_bits_through_nested_vmaps_and_alone():
    physics, want = native(load_spec("hopper.xml"), 4, Reads()), reference("hopper")[0]
    qpos, qvel, warmstart, ctrl = (jnp.asarray(x[:12]).reshape(3, 4, -1) for x in states("hopper"))
    state = physics.at_pose(qpos, qvel)._replace(qacc_warmstart=warmstart)
    nested = jax.jit(jax.vmap(jax.vmap(physics.step)))(state, ctrl)
    alone = jax.jit(physics.step)(jax.tree.map(lambda x: x[2, 1], state), ctrl[2, 1])
    assert_array_equal(nested.qpos.reshape(12, -1), want.qpos[:12].astype("float32"))
    assert_array_equal(alone.qvel, nested.qvel[2, 1])


@pytest.mark.parametrize("forces", [False, True])
def test_where_the_device_is_not_the_cpu_a_callback_returns_the_same_bits(forces):
    reads = Reads(("torso",), forces)
    physics = native(load_spec("ant.xml"), 5, reads)
    qpos, qvel, _, ctrl = (jnp.asarray(x[:6]).reshape(2, 3, -1) for x in states("ant"))
    state = physics.at_pose(qpos, qvel)
    after = jax.jit(jax.vmap(jax.vmap(physics.step)))(state, ctrl)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[2:], x.dtype), tuple(state))
    for ours, theirs in zip(
        after, _Host(physics.model, 5, reads).returned(like, *state[:3], ctrl), strict=True
    ):
        assert_array_equal(ours, theirs)
    assert after.cfrc_ext.size == (2 * 3 * 14 * 6 if forces else 0)


def test_a_non_finite_state_can_be_seen():
    physics = native(load_spec("hopper.xml"), 4, Reads())
    qpos, qvel, _, ctrl = (jnp.asarray(x[:2]) for x in states("hopper"))
    after = jax.jit(jax.vmap(physics.step))(physics.at_pose(qpos.at[0, 3].set(jnp.nan), qvel), ctrl)
    assert jnp.isnan(after.qpos[0]).any()
    assert jnp.isfinite(after.qpos[1]).all()


@pytest.mark.parametrize("forces", [False, True])
def test_mujocos_warnings_are_counted_and_said_once_and_leave_no_file(
    forces, monkeypatch, tmp_path, capfd, caplog
):
    monkeypatch.setattr(quiet, "COUNTS", Counter())
    monkeypatch.chdir(tmp_path)
    physics = native(load_spec("hopper.xml"), 4, Reads(forces=forces))
    qpos, qvel, _, ctrl = (jnp.asarray(x[:8]) for x in states("hopper"))
    step, broken = (
        jax.jit(jax.vmap(physics.step)),
        physics.at_pose(qpos.at[:3, 2].set(jnp.nan), qvel),
    )
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            jax.block_until_ready(step(broken, ctrl))
    # 3 worlds × 4 substeps × 5 calls
    assert quiet.COUNTS["BADQPOS"] == 60
    assert [r.message for r in caplog.records if "BADQPOS" in r.message] == [
        "MuJoCo warns of BADQPOS in physics native; from now on its warnings are counted, not shown"
    ]
    assert len(caplog.records) == len(quiet.COUNTS)
    assert "WARNING" not in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_whoever_listens_to_mujocos_warnings_hears_them_again_afterwards():
    heard = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    try:
        with quiet.silenced():
            warn_once()
        assert heard == []
        warn_once()
        assert len(heard) == 1
    finally:
        mujoco.set_mju_user_warning(before)


def warn_once():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qpos[0] = float("nan")
    mujoco.mj_checkPos(model, data)
