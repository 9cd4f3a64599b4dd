"""The form of the physics for accelerators: the same solution, in few turns of loops, which cost a launch each there."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from benchmarks.turns import counted, of_step
from tests.parity import reference, stepped


@pytest.mark.parametrize("name", ["ant", "hopper"])
def test_a_control_interval_is_that_of_a_cpu_up_to_rounding(name, elsewhere):
    got, want = stepped.__wrapped__(name, "jax"), reference(name)[0]
    assert_allclose(got.qpos, want.qpos, atol=1e-4)
    assert_allclose(got.qvel, want.qvel, atol=1e-3)
    assert_allclose(got.cfrc_ext, want.cfrc_ext, atol=1e-2, rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "most"), [("hopper", 150), pytest.param("ant", 400, marks=pytest.mark.slow)]
)
def test_an_environment_step_turns_few_loops(name, most):
    assert sum(of_step(name, 256, 1)) < most


def test_turns_and_products_are_counted_through_nested_loops_calls_and_branches():
    def program(x):
        x = jax.lax.scan(
            lambda c, _: (jax.lax.fori_loop(0, 3, lambda i, y: y + 1, c), None), x, length=5
        )[0]  # 5 · (1 + 3)
        x = jax.lax.while_loop(lambda y: y < 22, lambda y: y + 2, x)  # from 15: 4
        return jax.lax.cond(
            x > 0, jax.jit(lambda y: jax.lax.fori_loop(0, 7, lambda i, z: z + 1, y)), lambda y: y, x
        )  # 7

    out, counts = counted(program)(0)
    assert (int(out), int(counts.known), int(counts.asked), int(counts.flops)) == (30, 20 + 7, 4, 0)

    def products(a, b):
        return jax.lax.fori_loop(0, 6, lambda i, x: jnp.tanh(a @ x @ b), jnp.ones((3, 2)))

    assert int(counted(products)(jnp.ones((3, 3)), jnp.ones((2, 2)))[1].flops) == 6 * 2 * (
        3 * 3 * 2 + 3 * 2 * 2
    )
