"""The contract of every engine: names, bodies that a task may read, state that is carried."""

import subprocess
import sys

import jax.numpy as jnp
import mujoco
import pytest
from numpy.testing import assert_array_equal

from dgae_jax.envs.task import load_spec
from dgae_jax.physics import registry
from dgae_jax.physics.engine import Physics, Reads, body_ids
from dgae_jax.physics.registry import ENGINES, make_physics
from tests.helpers import ROOT
from tests.parity import WARP

ALL = [pytest.param(name, marks=WARP) if name == "mjx-warp" else name for name in ENGINES]
HIDDEN_STATE = """<mujoco><option integrator='RK4'/>
  <worldbody><body><joint name='j'/><geom size='.1'/></body></worldbody>
  <actuator><general joint='j' dyntype='integrator'/></actuator></mujoco>"""


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


def test_unknown_engine_is_refused_with_the_names():
    with pytest.raises(ValueError, match="'bullet': must be one of jax, mjx, mjx-warp, native"):
        make_physics("bullet", load_spec("hopper.xml"), 4, Reads())


def test_missing_engine_is_refused_with_how_to_install_it(monkeypatch):
    monkeypatch.setattr(registry, "find_spec", lambda name: None)
    registry.require("mjx")
    with pytest.raises(ValueError, match=r'needs the package warp.*install "dgae_jax\[warp\]"'):
        registry.require("mjx-warp")


@pytest.mark.parametrize("engine", ALL)
@pytest.mark.parametrize(
    ("body", "reason"),
    [("tail", "no body 'tail'"), ("front_left_leg", "'front_left_leg' cannot be read")],
)
def test_body_without_free_joint_is_refused(engine, body, reason):
    with pytest.raises(ValueError, match=reason):
        make_physics(engine, load_spec("ant.xml"), 5, Reads(bodies=(body,)))


@pytest.mark.parametrize("engine", ALL)
def test_model_with_hidden_state_is_refused(engine):
    with pytest.raises(ValueError, match=rf"physics {engine} does not cover .*activations"):
        make_physics(engine, mujoco.MjSpec.from_string(HIDDEN_STATE), 1, Reads())


def test_init_reads_floating_bodies_from_qpos():
    xml = """<mujoco><worldbody><body name='a' pos='1 1 1'><freejoint/><geom size='.1'/></body>
      <body name='b'><freejoint/><geom size='.1'/></body></worldbody></mujoco>"""
    model, reads = mujoco.MjModel.from_xml_string(xml), Reads(("b", "a"), forces=True)
    state = Physics(model, lambda state, ctrl: state, "none", reads).init(
        jnp.arange(28.0).reshape(2, 14), jnp.zeros((2, 12))
    )
    assert_array_equal(body_ids(model, reads), [2, 1])
    assert_array_equal(state.xpos, [[[7, 8, 9], [0, 1, 2]], [[21, 22, 23], [14, 15, 16]]])
    assert state.cfrc_ext.shape == (2, 3, 6)
