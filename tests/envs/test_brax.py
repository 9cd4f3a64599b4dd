"""Our tasks under Brax's wrappers and trainers."""

import os
import subprocess
import sys

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import EvalWrapper, wrap
from brax.training.agents.ppo import train as ppo
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.envs.brax import trainers
from tests.helpers import ROOT

LENGTH = 12


def test_brax_wrappers_tell_falls_from_time_limits():
    task = brax.envs.get_environment("dgae_hopper", physics="native")
    env = EvalWrapper(wrap(task, episode_length=LENGTH))
    # Brax takes the shape of legacy keys for that of the batch
    first = state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    assert state.obs.shape == (2, env.observation_size) == (2, 11)
    # the second env is about to fall over
    tilted = jnp.array(first.pipeline_state.qpos).at[:, 2].set(jnp.array([0, 0.19]))
    turning = jnp.array(first.pipeline_state.qvel).at[1, 2].set(2.0)
    moved = jax.vmap(lambda qpos, qvel: task.set_state(first, qpos, qvel))(tilted, turning)
    state = state.replace(pipeline_state=moved.pipeline_state)
    step, plain, still = jax.jit(env.step), jax.jit(jax.vmap(task.step)), jnp.zeros((2, 3))
    falls, limits = np.zeros(2), np.zeros(2)
    for _ in range(LENGTH):
        true = plain(state, still)
        state = step(state, still)
        ended, truncated = np.array(state.done) > 0, np.array(state.info["truncation"])
        falls += np.array(true.done)
        limits += truncated
        assert_array_equal(state.obs, np.where(ended[:, None], first.obs, true.obs))
        assert_allclose(state.reward, true.reward)
        assert_array_equal(ended, (np.array(true.done) > 0) | (truncated > 0))
    assert_array_equal(falls, [0, 1])
    assert_array_equal(limits, [1, 0])
    assert_array_equal(state.info["eval_metrics"].episode_steps, [LENGTH, 1])


def test_replicated_arrays_lie_on_both_devices_inside_trainers_only():
    program = """
import jax
from dgae_jax.envs.brax import trainers
with trainers():
    copies = jax.device_put_replicated({"a": jax.numpy.arange(3)}, jax.devices())["a"]
print([(shard.device.id, shard.data.tolist()) for shard in copies.addressable_shards])
print(hasattr(jax, "device_put_replicated"))
"""
    env = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "2"}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=True)
    assert done.stdout == "[(0, [[0, 1, 2]]), (1, [[0, 1, 2]])]\nFalse\n"


@pytest.mark.slow
def test_brax_ppo_trains_on_our_task():
    env = brax.envs.get_environment("dgae_hopper", physics="native")
    small = {"num_envs": 8, "num_eval_envs": 8, "unroll_length": 8, "batch_size": 8}
    with trainers():
        _, _, metrics = ppo.train(
            environment=env, num_timesteps=512, episode_length=40, num_minibatches=1, **small
        )
    assert np.isfinite(metrics["eval/episode_reward"])
    assert 1 <= metrics["eval/avg_episode_length"] <= 40
