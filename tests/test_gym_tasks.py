import warnings

import brax.envs
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg

PHYSICS = ["native", "mjx"]


@pytest.fixture(scope="module")
def gym():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gymnasium.make("Hopper-v4").unwrapped
    yield env
    env.close()


@pytest.fixture(scope="module")
def visited(gym):
    """Poses along random and held actions from random starts, upright to fallen, with the action taken there."""
    rng, kept = np.random.default_rng(0), []
    for episode in range(12):
        gym.reset(seed=episode)
        held = rng.uniform(-1, 1, 3)
        for _ in range(16):
            action = (rng.uniform(-1, 1, 3) if episode % 2 else held).astype(np.float32)
            kept.append((*(x.astype(np.float32) for x in (gym.data.qpos, gym.data.qvel)), action))
            gym.step(action)
    return tuple(np.stack(x) for x in zip(*kept, strict=True))


@pytest.fixture(scope="module", params=PHYSICS)
def stepped(request, visited):
    env = dg.make_env("hopper", physics=request.param)
    assert isinstance(env, Env)
    qpos, qvel, action = map(jnp.asarray, visited)

    @jax.jit
    def step(key, qpos, qvel, action):
        return jax.vmap(lambda q, v, a: env.step(env.set_state(env.reset(key), q, v), a))(qpos, qvel, action)

    return step(jax.random.key(0), qpos, qvel, action)


def test_one_step_agrees_with_gymnasium(stepped, visited, gym):
    for i, (qpos, qvel, action) in enumerate(zip(*visited, strict=True)):
        gym.reset()
        gym.set_state(qpos.astype(float), qvel.astype(float))
        obs, reward, terminated, _, info = gym.step(action)
        assert_allclose(stepped.obs[i], obs, atol=1e-3)
        assert_allclose(stepped.reward[i], reward, atol=1e-3)
        assert_allclose(stepped.metrics["x_velocity"][i], info["x_velocity"], atol=1e-3)
        assert bool(stepped.done[i]) == terminated


def test_the_comparison_sees_both_healthy_and_terminated_steps(stepped):
    assert 20 < int(stepped.done.sum()) < 150


def test_reward_is_the_sum_of_its_terms(stepped):
    terms = sum(stepped.metrics[name] for name in ("reward_forward", "reward_ctrl", "reward_survive"))
    assert_allclose(stepped.reward, terms, rtol=1e-6)


@pytest.mark.parametrize(
    "parameters",
    [
        {"forward_reward_weight": 2.0, "ctrl_cost_weight": 0.5, "healthy_reward": 3.0},
        {"terminate_when_unhealthy": False},
        {"healthy_z_range": (1.2, 1.3), "healthy_angle_range": (-0.05, 0.05), "healthy_state_range": (-5.0, 5.0)},
        {"exclude_current_positions_from_observation": False},
    ],
)
def test_task_parameters_mean_what_they_mean_in_gymnasium(parameters, visited):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gym = gymnasium.make("Hopper-v4", **parameters).unwrapped
    env = dg.make_env("hopper", physics="native", **parameters)
    step = jax.jit(lambda key, q, v, a: env.step(env.set_state(env.reset(key), q, v), a))
    for qpos, qvel, action in list(zip(*visited, strict=True))[::6]:
        gym.reset()
        gym.set_state(qpos.astype(float), qvel.astype(float))
        obs, reward, terminated, _, _ = gym.step(action)
        ours = step(jax.random.key(0), qpos, qvel, action)
        assert ours.obs.shape == obs.shape == (env.observation_size,)
        assert_allclose(ours.obs, obs, atol=1e-3)
        assert_allclose(ours.reward, reward, atol=3e-3)
        assert bool(ours.done) == terminated
    gym.close()


def test_the_control_cost_takes_the_action_as_given():
    env = dg.make_env("hopper", physics="native")
    state = jax.jit(env.reset)(jax.random.key(0))
    inside, outside = (jax.jit(env.step)(state, jnp.full(3, a)) for a in (1.0, 2.0))
    assert_array_equal(inside.obs, outside.obs)
    assert_allclose(outside.metrics["reward_ctrl"], -1e-3 * 12)


def test_resets_are_uniform_around_the_initial_pose_and_differ():
    env = dg.make_env("hopper", physics="native")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2_000))
    offset = np.asarray(states.pipeline_state.qpos) - [0, 1.25, 0, 0, 0, 0]
    for noise in (offset, np.asarray(states.pipeline_state.qvel)):
        assert np.abs(noise).max() <= 5e-3 + 1e-6
        assert_allclose(noise.std(0), 5e-3 / 3**0.5, rtol=0.08)
    assert len(np.unique(offset[:, 1])) > 1_900


def test_resets_accept_the_legacy_keys_of_braxs_own_trainers():
    env = dg.make_env("hopper", physics="native")
    assert jnp.isfinite(jax.jit(env.reset)(jax.random.PRNGKey(0)).obs).all()


def test_the_observation_clips_velocities_at_ten():
    env = dg.make_env("hopper", physics="native")
    state = env.set_state(env.reset(jax.random.key(0)), jnp.zeros(6), jnp.array([-20.0, 20, 3, 0, 0, 0]))
    assert_allclose(state.obs[5:8], [-10, 10, 3])


def test_braxs_own_wrappers_run_the_task():
    env = brax.envs.training.wrap(dg.make_env("hopper", physics="native"), episode_length=1000)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 4))
    state = jax.jit(env.step)(state, jnp.zeros((4, 3)))
    assert state.obs.shape == (4, 11)


@pytest.mark.parametrize(("name", "options"), [("hoper", {}), ("hopper", {"physics": "warp"}), ("hopper", {"version": "v9"})])
def test_unknown_names_are_refused_with_what_exists(name, options):
    with pytest.raises(ValueError, match=r"unknown .* choose from"):
        dg.make_env(name, **options)
