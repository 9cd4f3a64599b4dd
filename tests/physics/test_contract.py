"""The contract of every engine: packages, what a task may read, state that is carried."""

import subprocess
import sys

import jax.numpy as jnp
import mujoco
import pytest
from numpy.testing import assert_array_equal

from dgae_jax.physics import registry
from dgae_jax.physics.engine import Physics, Reads
from dgae_jax.physics.registry import ENGINES, make_physics
from tests.helpers import ROOT
from tests.parity import WARP

ALL = [pytest.param(name, marks=WARP) if name == "mjx-warp" else name for name in ENGINES]
HIDDEN_STATE = """<mujoco><option integrator='RK4'/>
  <worldbody><body><joint name='j'/><geom size='.1'/></body></worldbody>
  <actuator><general joint='j' dyntype='integrator'/></actuator></mujoco>"""
FLOATING = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"


def test_registries_load_no_engine():
    code = """
import sys, types
package = types.ModuleType("dgae_jax")
package.__path__, sys.modules["dgae_jax"] = ["dgae_jax"], package
import dgae_jax.physics.registry as physics, dgae_jax.envs.registry as envs
envs.spec_of("brax:ant"), physics.ENGINES
print(sorted({"jax", "mujoco", "brax", "flax", "gymnasium", "warp"} & set(sys.modules)))"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_missing_engine_is_refused_with_how_to_install_it(monkeypatch):
    monkeypatch.setattr(registry, "find_spec", lambda name: None)
    registry.require("mjx")
    with pytest.raises(ValueError, match=r'needs the package warp.*install "dgae_jax\[warp\]"'):
        registry.require("mjx-warp")


@pytest.mark.parametrize("engine", ALL)
def test_model_with_hidden_state_is_refused(engine):
    with pytest.raises(ValueError, match=rf"physics {engine} does not cover .*na"):
        make_physics(engine, mujoco.MjSpec.from_string(HIDDEN_STATE), 1, Reads())


def test_init_reads_the_root_from_qpos():
    model = mujoco.MjModel.from_xml_string(FLOATING)
    physics = Physics(model, lambda state, ctrl: state, "none", Reads(xpos=True, cfrc_ext=True))
    state = physics.init(jnp.arange(14.0).reshape(2, 7), jnp.zeros((2, 6)))
    assert_array_equal(state.xpos, [[[0, 1, 2]], [[7, 8, 9]]])
    assert state.cfrc_ext.shape == (2, 2, 6)
