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
    shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
    return jax.ffi.ffi_call(name, shape, vmap_method="broadcast_all")(x)


def test_function_reads_and_fills_arrays_of_the_program():
    ffi.register("test_doubled", doubled)
    x = jnp.arange(24.0).reshape(2, 3, 4)
    nested = jax.jit(jax.vmap(jax.vmap(lambda x: call("test_doubled", x))))
    np.testing.assert_array_equal(nested(x), 2 * x)
    empty = jax.jit(call, static_argnums=0)("test_doubled", jnp.zeros((2, 0, 6)))
    assert empty.shape == (2, 0, 6)
    loop = jax.jit(lambda x: jax.lax.fori_loop(0, 10, lambda _, x: call("test_doubled", x), x))
    np.testing.assert_array_equal(loop(x), 1024 * x)
    with jax.enable_x64(True):
        got = jax.jit(call, static_argnums=0)("test_doubled", jnp.asarray([1 / 3]))
    np.testing.assert_array_equal(got, np.array([2 / 3]))


def test_exception_ends_the_program_with_its_message():
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

import dgae_jax as dg

physics = dg.make_env("hopper", physics="native").physics
state = physics.init(jnp.zeros((3, 6)).at[:, 1].set(1.25), jnp.zeros((3, 6)))
ctrl = jnp.ones((3, 3))
events.clear()
after = jax.jit(jax.vmap(physics.step))(state, ctrl)
hits = events.count("/jax/compilation_cache/cache_hits")
print(json.dumps({"hits": hits, "qpos": after.qpos.tolist()}))
"""


def test_another_process_finds_native_physics_in_the_cache(tmp_path):
    command = [sys.executable, "-c", PROGRAM, tmp_path]
    first, second = (
        json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout)
        for _ in range(2)
    )
    assert (first["hits"], second["hits"]) == (0, 1)
    assert first["qpos"] == second["qpos"]
