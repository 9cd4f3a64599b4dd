"""Tasks of Gymnasium in a compiled program, against Gymnasium stepped by hand."""

import gc
import weakref

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import dgae_jax as dg
from dgae_jax.envs import gymnasium as tasks
from dgae_jax.envs.noise import Noisy
from dgae_jax.learn.rollout import rollout, start

ENVS = 3


def roll_out(env, key, steps, limit=1000):
    """Random actions in eighths, which no program rounds, some beyond the range."""

    def act(keys, obs):
        action = jax.vmap(lambda key: jax.random.randint(key, (env.action_size,), -32, 33) / 8)
        return action(keys), jnp.zeros(len(obs))

    first = start(env, jax.random.split(key, ENVS))
    keys = jax.random.split(key, (steps, ENVS))
    return rollout(env, act, first, keys, episode_length=limit), first


@pytest.mark.parametrize(
    ("name", "steps", "limit"),
    [("Pendulum-v1", 220, 1000), ("InvertedPendulum-v5", 40, 8)],
)
def test_rollout_equals_gymnasium_step_by_step(name, steps, limit, key):
    env = dg.make_env(f"gymnasium:{name}")
    (_, step), first = jax.jit(roll_out, static_argnums=(0, 2, 3))(env, key, steps, limit)
    high, low = np.asarray(first.env.pipeline_state.seed, np.uint64).T
    for i in range(ENVS):
        longest = min(limit, gymnasium.spec(name).max_episode_steps)
        gym = gymnasium.make(name, max_episode_steps=longest)
        obs, _ = gym.reset(seed=int(high[i]) << 32 | int(low[i]))
        over, t = False, 0
        while not over:
            assert_array_equal(step.obs[t, i], np.float32(obs))
            space = gym.action_space
            action = np.clip(np.asarray(step.action[t, i]), space.low, space.high)
            obs, reward, terminated, truncated, _ = gym.step(action)
            assert_array_equal(step.next_obs[t, i], np.float32(obs))  # the true successor
            assert step.reward[t, i] == np.float32(reward)
            assert step.terminated[t, i] == terminated
            assert step.truncated[t, i] == (truncated and not terminated)
            over, t = terminated or truncated, t + 1
        assert t < steps
        assert not np.allclose(step.obs[t, i], obs)  # another episode
        gym.close()


def test_same_key_gives_same_numbers_again_and_vmapped(key):
    env = dg.make_env("gymnasium:Pendulum-v1")
    run = jax.jit(lambda key: roll_out(env, key, 210)[0])
    once, again = run(key), run(key)
    both = jax.vmap(run)(jnp.stack([key, jax.random.key(1)]))
    jax.tree.map(lambda a, b, c: [assert_array_equal(x, a) for x in (b, c[0])], once, again, both)
    assert jnp.abs(both[1].obs[0] - both[1].obs[1]).max() > 0.1


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: Noisy(env, observation=0.1)])
def test_env_restarts_only_where_its_episode_has_ended(wrap, key, monkeypatch):
    begun, begin = [], tasks._Envs._begin

    def counted(self, i, seed):
        begun.append(i)
        return begin(self, i, seed)

    monkeypatch.setattr(tasks._Envs, "_begin", counted)
    env = wrap(dg.make_env("gymnasium:InvertedPendulum-v5"))
    (_, step), _ = jax.block_until_ready(jax.jit(lambda key: roll_out(env, key, 40))(key))
    ended = (step.terminated | step.truncated).sum(0)
    assert ended.min() > 0
    assert_array_equal(np.bincount(begun), ended + 1)


def test_env_only_goes_forward(key):
    env = dg.make_env("gymnasium:Pendulum-v1")
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(key)
    after = step(state, jnp.ones(1))
    step(after, jnp.ones(1))
    with pytest.raises(jax.errors.JaxRuntimeError, match="only goes forward"):
        jax.block_until_ready(step(after, jnp.ones(1)))
    # the beginning of an episode can be gone back to
    assert_array_equal(step(state, jnp.ones(1)).obs, after.obs)


def test_gymnasium_envs_are_closed_with_their_task(key):
    env = dg.make_env("gymnasium:Pendulum-v1")
    jax.block_until_ready(jax.jit(env.reset)(key))
    envs = weakref.ref(env._envs)
    del env
    gc.collect()
    assert envs() is None


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("CartPole-v1", r"its actions are Discrete\(2\), and must be a Box with one axis"),
        ("Nope-v1", "Gymnasium cannot make it: NameNotFound: Environment `Nope` doesn't exist"),
        ("nowhere:Nope-v1", "Gymnasium cannot make it: ModuleNotFoundError"),
    ],
)
def test_unsupported_task_is_refused_with_the_reason(name, reason):
    with pytest.raises(ValueError, match=reason):
        dg.make_env(f"gymnasium:{name}")


@pytest.mark.parametrize(
    "space", [gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8), gymnasium.spaces.Dict()]
)
def test_observations_that_are_not_vectors_are_refused(space, monkeypatch):
    made = gymnasium.make("Pendulum-v1")
    made.observation_space = space
    monkeypatch.setattr(gymnasium, "make", lambda *_, **__: made)
    with pytest.raises(ValueError, match=r"its observations are .*, and must be a Box"):
        dg.make_env("gymnasium:Pendulum-v1")
