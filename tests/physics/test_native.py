"""C MuJoCo inside jitted programs: batches of any shape, non-finite states, and its warnings."""

import logging
from collections import Counter

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_array_equal

from dgae_jax.envs.task import load_spec
from dgae_jax.physics import native as native_module
from dgae_jax.physics.engine import Reads
from dgae_jax.physics.native import _Simulations, native
from tests.parity import reference, start


def test_nested_vmaps_and_single_env_have_the_same_bits():
    physics, want = native(load_spec("hopper.xml"), 4, Reads()), reference("hopper")[0]
    state, ctrl = start(physics, "hopper", 3, 4)
    nested = jax.jit(jax.vmap(jax.vmap(physics.step)))(state, ctrl)
    alone = jax.jit(physics.step)(jax.tree.map(lambda x: x[2, 1], state), ctrl[2, 1])
    assert_array_equal(nested.qpos.reshape(12, -1), want.qpos[:12].astype("float32"))
    assert_array_equal(alone.qvel, nested.qvel[2, 1])


@pytest.mark.parametrize("forces", [False, True])
def test_callback_of_other_devices_returns_the_same_bits(forces):
    reads = Reads(xpos=True, cfrc_ext=forces)
    physics = native(load_spec("ant.xml"), 5, reads)
    state, ctrl = start(physics, "ant", 2, 3)
    after = jax.jit(jax.vmap(jax.vmap(physics.step)))(state, ctrl)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[2:], x.dtype), tuple(state))
    called = _Simulations(physics.model, 5, reads).callback(like, *state[:3], ctrl)
    jax.tree.map(assert_array_equal, tuple(after), called)
    assert after.cfrc_ext.size == (2 * 3 * 14 * 6 if forces else 0)


def test_non_finite_state_stays_visible():
    physics = native(load_spec("hopper.xml"), 4, Reads())
    state, ctrl = start(physics, "hopper", 2)
    broken = state._replace(qpos=state.qpos.at[0, 3].set(jnp.nan))
    after = jax.jit(jax.vmap(physics.step))(broken, ctrl)
    assert jnp.isnan(after.qpos[0]).any()
    assert jnp.isfinite(after.qpos[1]).all()


@pytest.mark.parametrize("forces", [False, True])
def test_warnings_are_counted_and_logged_once(forces, monkeypatch, tmp_path, capfd, caplog):
    monkeypatch.setattr(native_module, "WARNING_COUNTS", Counter())
    monkeypatch.chdir(tmp_path)
    physics = native(load_spec("hopper.xml"), 4, Reads(cfrc_ext=forces))
    state, ctrl = start(physics, "hopper", 8)
    broken = physics.init(state.qpos.at[:3, 2].set(jnp.nan), state.qvel)
    step = jax.jit(jax.vmap(physics.step))
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            jax.block_until_ready(step(broken, ctrl))
    # 3 envs × 4 substeps × 5 calls
    assert native_module.WARNING_COUNTS["BADQPOS"] == 60
    assert sum("MuJoCo warns of BADQPOS" in r.message for r in caplog.records) == 1
    assert len(caplog.records) == len(native_module.WARNING_COUNTS)
    assert "WARNING" not in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []
