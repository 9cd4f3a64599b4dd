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
from brax.training.agents.ppo.losses import compute_gae
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.envs.brax import trainers
from tests.helpers import ROOT

LENGTH = 12


def test_braxs_wrappers_tell_a_fall_from_a_time_limit_and_hide_where_an_episode_ended():
    task = brax.envs.get_environment("dgae_hopper", physics="native")
    env = EvalWrapper(wrap(task, episode_length=LENGTH))
    first = state = jax.jit(env.reset)(
        jax.random.split(jax.random.PRNGKey(0), 2)
    )  # Brax takes their shape for that of the worlds
    assert state.obs.shape == (2, env.observation_size) == (2, 11)
    tilted = (
        jnp.array(first.pipeline_state.qpos).at[1, 2].set(0.19).at[0, 2].set(0)
    )  # the second world is about to fall over
    turning = jnp.array(first.pipeline_state.qvel).at[1, 2].set(2.0)
    moved = jax.vmap(lambda qpos, qvel: task.set_state(first, qpos, qvel))(tilted, turning)
    state = state.replace(pipeline_state=moved.pipeline_state)
    step, plain, still = jax.jit(env.step), jax.jit(jax.vmap(task.step)), jnp.zeros((2, 3))
    falls, limits = np.zeros(2), np.zeros(2)
    for _ in range(LENGTH):
        true = plain(state, still)
        state = step(state, still)
        ended = np.array(state.done) > 0
        falls += np.array(true.done)
        limits += np.array(state.info["truncation"])
        assert_array_equal(state.obs, np.where(ended[:, None], first.obs, true.obs))
        assert_allclose(state.reward, true.reward)
        assert_array_equal(
            ended, (np.array(true.done) > 0) | (np.array(state.info["truncation"]) > 0)
        )
    assert_array_equal(falls, [0, 1])
    assert_array_equal(limits, [1, 0])
    assert_array_equal(state.info["eval_metrics"].episode_steps, [LENGTH, 1])


def test_braxs_wrappers_take_the_shape_of_raw_keys_for_that_of_the_worlds():
    env = wrap(brax.envs.get_environment("dgae_hopper", physics="native"))
    keys = jax.random.split(jax.random.PRNGKey(0), 2), jax.random.split(jax.random.key(0), 2)
    assert [jax.eval_shape(env.reset, each).info["steps"].shape for each in keys] == [(2,), ()]


def test_braxs_ppo_leaves_out_the_step_of_a_time_limit():
    truncation, reward, value = (
        jnp.array([[0.0], [1.0]]),
        jnp.array([[1.0], [5.0]]),
        jnp.array([[2.0], [3.0]]),
    )
    target, advantage = compute_gae(
        truncation, jnp.zeros((2, 1)), reward, value, jnp.array([9.0]), lambda_=0.5, discount=0.9
    )
    assert_allclose(target, [[1 + 0.9 * 3], [3]], rtol=1e-6)
    assert_allclose(advantage, [[1 + 0.9 * 3 - 2], [0]], rtol=1e-6)


def test_braxs_trainers_find_what_jax_took_away_only_inside():
    with trainers():
        assert jax.device_put_replicated({"a": jnp.arange(3)}, jax.devices()[:1])["a"].tolist() == [
            [0, 1, 2]
        ]
    assert not hasattr(jax, "device_put_replicated")


def test_what_braxs_trainers_copy_to_two_devices_lies_on_both():
    program = """
import jax
from dgae_jax.envs.brax import trainers
with trainers():
    copies = jax.device_put_replicated({"a": jax.numpy.arange(3)}, jax.devices())["a"]
print([(shard.device.id, shard.data.tolist()) for shard in copies.addressable_shards])
"""
    two = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "2"}
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env=two,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "[(0, [[0, 1, 2]]), (1, [[0, 1, 2]])]\n"


@pytest.mark.slow
def test_braxs_ppo_learns_to_hop():
    """Its evaluations before and after; a longer run of these settings had returns of 26 and, at 40,960 steps, 129."""
    seen = []
    with trainers():
        ppo.train(
            environment=brax.envs.get_environment("dgae_hopper", physics="jax"),
            num_timesteps=40_960, episode_length=1000, num_envs=64, num_eval_envs=16, unroll_length=16, batch_size=64, num_minibatches=8,
            num_updates_per_batch=4, discounting=0.99, learning_rate=1e-3, entropy_cost=0.0, normalize_observations=True,
            reward_scaling=0.1, num_evals=2, seed=0, progress_fn=lambda steps, metrics: seen.append((steps, metrics)),
        )  # fmt: skip
    (_, before), (steps, after) = seen
    assert steps >= 40_960
    assert all(np.isfinite(value).all() for _, metrics in seen for value in metrics.values())
    assert before["eval/episode_reward"] < 50 < 70 < after["eval/episode_reward"]
    assert 1 <= before["eval/avg_episode_length"] < after["eval/avg_episode_length"] <= 1000
