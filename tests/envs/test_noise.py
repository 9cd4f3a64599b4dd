import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.envs.noise import Noisy
from dgae_jax.learn.build import make_task
from dgae_jax.learn.rollout import rollout, start
from tests.probes import Constant, Counter


def collect(env, key):
    def act(key, obs):
        return jnp.zeros((obs.shape[0], 1)), jnp.zeros(obs.shape[0])

    first, keys = start(env, jax.random.split(key, 16)), jax.random.split(key, (400, 16))
    return rollout(env, act, first, keys, episode_length=50)[1]


def test_task_is_wrapped_only_with_noise():
    for noise in (dg.NoiseConfig(), dg.NoiseConfig(reward=1.0)):
        config = dg.resolve(dg.Config(env="hopper", physics="native", noise=noise))
        assert isinstance(make_task(config), Noisy) == (noise.reward > 0)


def test_reward_noise_has_its_deviation(key):
    reward = np.asarray(collect(Noisy(Constant(), reward=0.5), key).reward)
    assert_allclose([reward.mean(), reward.std()], [1, 0.5], atol=0.03)
    assert len(np.unique(reward)) > 0.99 * reward.size


def test_observation_noise_does_not_enter_the_task(key):
    step = collect(Noisy(Counter(), observation=0.1), key)
    truth = jnp.round(step.obs[..., 0])
    assert_allclose((step.obs[..., 0] - truth).std(), 0.1, atol=0.01)
    assert_array_equal(step.reward, truth + 1)  # the counter counts true steps


def test_action_noise_reaches_the_task(key):
    env = Noisy(Counter(), action=0.2)
    step = jax.vmap(lambda key: env.step(env.reset(key), jnp.ones(1)))
    action = jax.jit(step)(jax.random.split(key, 500)).metrics["action"]
    assert_allclose([action.mean(), action.std()], [1, 0.2], atol=0.03)


def test_initial_noise_is_for_our_own_tasks(key):
    env = Noisy(dg.make_env("swimmer", physics="native", reset_noise_scale=0.0), initial=0.3)
    qpos = jax.jit(jax.vmap(env.reset))(jax.random.split(key, 500)).pipeline_state.qpos
    assert_allclose(qpos.std(0), 0.3, atol=0.03)
    with pytest.raises(ValueError, match="our own tasks"):
        Noisy(Constant(), initial=0.1)
