"""What an accelerator would run, as far as a machine without one can tell."""

import dataclasses

import jax
import jax.export
import pytest

import dgae_jax as dg
from dgae_jax.envs.registry import TASKS
from tests.helpers import small


@pytest.mark.parametrize("physics", ["jax", "mjx"])
@pytest.mark.parametrize(
    "algo",
    [
        "dppo",
        "dtrpo",
        "da2c",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("ppo", "trpo", "a2c")),
    ],
)
def test_the_training_step_lowers_for_cuda_and_tpu_without_a_call_to_the_host(algo, physics):
    config, env = (
        dataclasses.replace(small(algo), physics=physics),
        dg.make_env("hopper", physics=physics),
    )
    init, step = dg.make_train(dg.make_algorithm(algo, env, config), env, config)
    state = jax.eval_shape(init, jax.random.key(0))
    program = jax.export.export(jax.jit(step), platforms=["cuda", "tpu"])(state).mlir_module()
    assert "stablehlo.while" in program
    assert "callback" not in program


@pytest.mark.parametrize("name", TASKS)
def test_the_environment_step_of_every_task_lowers_for_cuda_and_tpu_without_a_call_to_the_host(
    name,
):
    env = dg.make_env(name, physics="jax")
    state = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 300))
    action = jax.ShapeDtypeStruct((300, env.action_size), "float32")
    program = jax.export.export(jax.jit(jax.vmap(env.step)), platforms=["cuda", "tpu"])(
        state, action
    ).mlir_module()
    assert "callback" not in program
