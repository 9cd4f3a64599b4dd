"""Programs for accelerators, as far as a machine without one can tell."""

import jax
import jax.export
import pytest

import dgae_jax as dg
from tests.helpers import small


@pytest.mark.parametrize(
    ("algo", "env", "physics"),
    [
        ("dppo", "hopper", "jax"),
        ("dtrpo", "swimmer", "jax"),
        pytest.param("dppo", "hopper", "mjx", marks=pytest.mark.slow),
        pytest.param("a2c", "walker2d", "mjx", marks=pytest.mark.slow),
    ],
)
def test_a_training_step_for_cuda_and_tpu_never_calls_the_host(algo, env, physics):
    config = small(algo, env=env).replace(physics=physics)
    task = dg.make_env(env, physics=physics)
    init, step = dg.make_train(dg.make_algorithm(algo, task, config), task, config)
    state = jax.eval_shape(init, jax.random.key(0))
    program = jax.export.export(jax.jit(step), platforms=["cuda", "tpu"])(state).mlir_module()
    assert "stablehlo.while" in program
    assert "callback" not in program
