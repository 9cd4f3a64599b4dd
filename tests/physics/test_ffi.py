"""Python functions as custom calls of XLA."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dgae_jax.physics import ffi
from tests.helpers import ROOT


def doubled(before, after):
    after[0][:] = 2 * before[0]


def call(name, x):
    return jax.ffi.ffi_call(
        name, jax.ShapeDtypeStruct(x.shape, x.dtype), vmap_method="broadcast_all"
    )(x)


def test_a_function_reads_and_fills_the_arrays_of_the_program():
    ffi.register("test_doubled", doubled)
    x = jnp.arange(24.0).reshape(2, 3, 4)
    nested = jax.jit(jax.vmap(jax.vmap(lambda x: call("test_doubled", x))))
    np.testing.assert_array_equal(nested(x), 2 * x)
    np.testing.assert_array_equal(
        jax.jit(call, static_argnums=0)("test_doubled", jnp.zeros((2, 0, 6))), np.zeros((2, 0, 6))
    )
    loop = jax.jit(lambda x: jax.lax.fori_loop(0, 10, lambda _, x: call("test_doubled", x), x))
    np.testing.assert_array_equal(loop(x), 1024 * x)


def test_float64_arrays_arrive_as_they_are():
    with jax.enable_x64(True):
        x = jnp.asarray([1 / 3])
        assert x.dtype == np.float64
        ffi.register("test_doubled", doubled)
        np.testing.assert_array_equal(
            jax.jit(call, static_argnums=0)("test_doubled", x), 2 / 3 * np.ones(1)
        )


def test_an_exception_ends_the_program_and_says_what_it_was():
    def broken(before, after):
        raise ZeroDivisionError("by nought")

    ffi.register("test_broken", broken)
    with pytest.raises(jax.errors.JaxRuntimeError, match="ZeroDivisionError: by nought"):
        jax.block_until_ready(jax.jit(call, static_argnums=0)("test_broken", jnp.zeros(3)))


PROGRAM = """
import json, sys
import jax
import jax.numpy as jnp

events = []
jax.monitoring.register_event_listener(lambda name, **_: events.append(name))
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)

from dgae_jax.envs.task import load_spec
from dgae_jax.physics.engine import Reads
from dgae_jax.physics.native import native

physics = native(load_spec("hopper.xml"), 4, Reads())
state = physics.at_pose(jnp.zeros((3, 6)).at[:, 1].set(1.25), jnp.zeros((3, 6)))
ctrl = jnp.ones((3, 3))
events.clear()
after = jax.jit(jax.vmap(physics.step))(state, ctrl)
print(json.dumps({"hits": events.count("/jax/compilation_cache/cache_hits"), "qpos": after.qpos.tolist()}))
"""


def test_another_process_finds_a_program_with_native_physics_in_the_cache_and_gets_the_same_bits(
    tmp_path,
):
    command = [sys.executable, "-c", PROGRAM, tmp_path]
    first, second = (
        json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout)
        for _ in range(2)
    )
    assert (first["hits"], second["hits"]) == (0, 1)
    assert first["qpos"] == second["qpos"]
