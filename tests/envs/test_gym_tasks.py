import dataclasses
import functools
import inspect
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.envs.gym_tasks import GYM_TASKS
from tests.parity import UPSTREAM, WARP

PLAIN = [(name, version) for name in sorted(GYM_TASKS) for version in ("v4", "v5")]


def gymnasium_task(name, version, **parameters):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gymnasium.make(f"{GYM_TASKS[name].NAME}-{version}", **parameters).unwrapped


@functools.cache
def visited(name):
    """Poses along random and held actions, upright to fallen, with the action taken there."""
    gym, rng, kept = gymnasium_task(name, "v4"), np.random.default_rng(0), []
    for episode in range(8):
        gym.reset(seed=episode)
        if episode % 4 == 3:  # thrown
            gym.set_state(gym.data.qpos, gym.data.qvel + rng.normal(0, 3, gym.model.nv))
        held = rng.uniform(-1, 1, gym.action_space.shape)
        for _ in range(48):
            action = (rng.uniform(-1, 1, held.shape) if episode % 2 else held).astype(np.float32)
            kept.append((*(x.astype(np.float32) for x in (gym.data.qpos, gym.data.qvel)), action))
            gym.step(action)
    gym.close()
    return tuple(np.stack(x) for x in zip(*kept, strict=True))


def taken(env, qpos, qvel, action):
    """One step of `env` from each pose."""

    @jax.jit
    def step(key, qpos, qvel, action):
        return jax.vmap(lambda q, v, a: env.step(env.set_state(env.reset(key), q, v), a))(
            qpos, qvel, action
        )

    return step(jax.random.key(0), *map(jnp.asarray, (qpos, qvel, action)))


def assert_steps_agree(ours, gym, poses, observation=1e-3, reward=1e-3):
    for i, (qpos, qvel, action) in enumerate(zip(*poses, strict=True)):
        gym.reset()
        gym.set_state(qpos.astype(float), qvel.astype(float))
        obs, theirs, terminated, _, info = gym.step(action)
        assert_allclose(ours.obs[i], obs, atol=observation)
        assert_allclose(ours.reward[i], theirs, atol=reward)
        assert bool(ours.done[i]) == terminated
        for name in set(ours.metrics) & set(info) - {"x_position", "y_position", "reward_ctrl"}:
            assert_allclose(ours.metrics[name][i], info[name], atol=reward, err_msg=name)
    gym.close()


slow = pytest.mark.slow
CASES = [
    *(("native", *case) for case in PLAIN),
    ("jax", "swimmer", "v4"),
    *(pytest.param("jax", name, "v5", marks=slow) for name in sorted(GYM_TASKS)),
]
for engine, marks in (("mjx", [slow]), ("mjx-warp", [slow, WARP])):
    for case in PLAIN:
        upstream = [UPSTREAM] if case[0] == "ant" else []
        CASES.append(pytest.param(engine, *case, marks=marks + upstream))


@pytest.mark.parametrize(("physics", "name", "version"), CASES)
def test_one_step_agrees_with_gymnasium(physics, name, version):
    env = dg.make_env(name, physics=physics, version=version)
    assert isinstance(env, Env)
    ours = taken(env, *visited(name))
    terms = sum(ours.metrics[term] for term in ours.metrics if term.startswith("reward_"))
    assert_allclose(ours.reward, terms, rtol=1e-5, atol=1e-5)
    assert_steps_agree(ours, gymnasium_task(name, version), visited(name))
    assert bool(ours.done.any()) == (name != "swimmer")  # both kinds of steps are compared
    assert not ours.done.all()


NARROW = {
    "healthy_z_range": (1.2, 1.3),
    "healthy_angle_range": (-0.05, 0.05),
    "healthy_state_range": (-5.0, 5.0),
}
SHOWN = {"exclude_current_positions_from_observation": False}
PARAMETERS = [
    ("hopper", {"forward_reward_weight": 2.0, "ctrl_cost_weight": 0.5, "healthy_reward": 3.0}),
    ("hopper", {"terminate_when_unhealthy": False, **SHOWN}),
    ("hopper", NARROW),
    ("walker2d", {"healthy_z_range": (1.0, 1.3), "healthy_angle_range": (-0.1, 0.5)}),
    ("swimmer", {"forward_reward_weight": 3.0, "ctrl_cost_weight": 0.1, **SHOWN}),
    ("ant", {"healthy_z_range": (0.4, 0.6), "ctrl_cost_weight": 0.1, **SHOWN}),
    ("ant", {"contact_cost_weight": 0.1, "contact_force_range": (-0.5, 0.2)}),
]


@pytest.mark.parametrize(
    ("name", "parameters", "version"),
    [
        *((*case, version) for case in PARAMETERS for version in ("v4", "v5")),
        ("ant", {"use_contact_forces": True}, "v4"),
        ("ant", {"include_cfrc_ext_in_observation": False}, "v5"),
    ],
)
def test_task_parameters_mean_the_same_in_gymnasium(name, parameters, version):
    poses = tuple(x[::8] for x in visited(name))
    env = dg.make_env(name, physics="native", version=version, **parameters)
    gym = gymnasium_task(name, version, **parameters)
    ours = taken(env, *poses)
    assert ours.obs.shape[1:] == gym.observation_space.shape == (env.observation_size,)
    assert_steps_agree(ours, gym, poses, reward=3e-3)


@pytest.mark.parametrize(("name", "version"), PLAIN)
def test_constants_are_gymnasiums(name, version):
    gym, env = gymnasium_task(name, version), dg.make_env(name, physics="native", version=version)
    signature = inspect.signature(type(gym).__init__).parameters
    theirs = {k: p.default for k, p in signature.items() if p.default is not p.empty}
    ours = {field.name: field.default for field in dataclasses.fields(env)}
    for key in set(theirs) - {"xml_file", "frame_skip", "default_camera_config", "main_body"}:
        assert ours[key] == theirs[key], key
    assert gym.frame_skip == env.FRAME_SKIP
    assert env.FILE[version] == gym.fullpath.rsplit("/", 1)[-1]
    assert env.dt == pytest.approx(gym.dt)
    low, high = env.action_range
    assert_allclose(low, gym.action_space.low)
    assert_allclose(high, gym.action_space.high)
    gym.close()


def test_control_cost_takes_the_action_as_given():
    env = dg.make_env("hopper", physics="native")
    state = jax.jit(env.reset)(jax.random.key(0))
    inside, outside = (jax.jit(env.step)(state, jnp.full(3, a)) for a in (1.0, 2.0))
    assert_array_equal(inside.obs, outside.obs)
    assert_allclose(outside.metrics["reward_ctrl"], -1e-3 * 12)


@pytest.mark.parametrize("name", sorted(GYM_TASKS))
def test_resets_scatter_as_in_gymnasium(name):
    env = dg.make_env(name, physics="native")
    scale = env.reset_noise_scale
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 4_000)).pipeline_state
    position, velocity = np.asarray(states.qpos - env.physics.model.qpos0), np.asarray(states.qvel)
    assert np.abs(position).max() <= scale * (1 + 1e-3)
    assert_allclose(position.std(0), scale / 3**0.5, rtol=0.06)
    assert_allclose(velocity.std(0), scale if name == "ant" else scale / 3**0.5, rtol=0.06)
    assert (np.abs(velocity).max() > scale * 1.5) == (name == "ant")
    assert len(np.unique(position[:, 1])) > 3_500
