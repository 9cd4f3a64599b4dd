"""Tasks of MuJoCo Playground, where it is installed."""

from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.learn.rollout import rollout, start

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        find_spec("mujoco_playground") is None, reason="playground is not installed"
    ),
    pytest.mark.filterwarnings("default"),  # its own
]


def test_unknown_task_is_refused_with_similar_names():
    with pytest.raises(ValueError, match="Playground has no CartpoleBalanced, but CartpoleBalance"):
        dg.make_env("playground:CartpoleBalanced")


def test_task_that_would_download_its_robot_is_refused(monkeypatch, tmp_path):
    from mujoco_playground._src import mjx_env

    monkeypatch.setattr(mjx_env, "MENAGERIE_PATH", tmp_path / "mujoco_menagerie")
    monkeypatch.setattr(mjx_env, "ensure_menagerie_exists", lambda: pytest.fail("a download"))
    with pytest.raises(ValueError, match=r"its robot is in mujoco_menagerie, .* would download"):
        dg.make_env("playground:Go1Getup")


def test_parameters_override_the_configuration(key):
    env = dg.make_env("playground:CartpoleBalance", episode_length=7)
    assert env._env.episode_length == 7
    with pytest.raises(ValueError, match=r"its configuration is .*episode_length.*: .*wheels"):
        dg.make_env("playground:CartpoleBalance", wheels=3)


def test_task_equals_playgrounds_own_with_truncation(key):
    from mujoco_playground import registry

    env = dg.make_env("playground:CartpoleBalance")
    theirs = registry.load("CartpoleBalance", config_overrides={"impl": "jax"})
    assert (env.observation_size, env.action_size, env.backend) == (5, 1, "mjx")
    assert_array_equal(env.action_range, [[-1], [1]])

    def act(keys, obs):
        return jnp.tanh(obs[:, :1]), jnp.zeros(len(obs))

    keys = jax.random.split(key, (1010, 1))
    first = jax.jit(lambda key: start(env, key[None]))(key)
    _, step = jax.jit(lambda first: rollout(env, act, first, keys, episode_length=10**6))(first)
    assert step.mask.all()
    assert not step.terminated.any()
    assert_array_equal(np.flatnonzero(step.truncated), [999])
    state, advance = jax.jit(theirs.reset)(key), jax.jit(theirs.step)
    for t in range(20):
        state = advance(state, step.action[t, 0])
        assert_allclose(step.next_obs[t, 0], state.obs, atol=1e-5)
        assert_allclose(step.reward[t, 0], state.reward, atol=1e-5)
