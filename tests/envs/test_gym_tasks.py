import functools
import inspect
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
from tests.helpers import GYM_TASKS
from tests.parity import UPSTREAM, WARP

PLAIN = [(name, version) for name in sorted(GYM_TASKS) for version in ("v4", "v5")]


def gymnasium_task(name, version, **parameters):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gymnasium.make(f"{GYM_TASKS[name].NAME}-{version}", **parameters).unwrapped


@functools.cache
def visited(name):
    """Poses along random and held actions from random starts, upright to fallen, with the action taken there."""
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
        for name in {
            "x_velocity",
            "y_velocity",
            "reward_forward",
            "reward_survive",
            "reward_contact",
        } & set(info):
            assert_allclose(ours.metrics[name][i], info[name], atol=reward, err_msg=name)
    gym.close()


slow = pytest.mark.slow
CASES = [
    *(("native", *case) for case in PLAIN),
    *(("jax", name, "v4") for name in sorted(GYM_TASKS)),
    ("jax", "ant", "v5"),
    *(pytest.param("jax", name, "v5", marks=slow) for name in sorted(GYM_TASKS) if name != "ant"),
    *(
        pytest.param("mjx", *case, marks=(slow, UPSTREAM) if case[0] == "ant" else slow)
        for case in PLAIN
    ),
    *(
        pytest.param(
            "mjx-warp", *case, marks=(slow, WARP, UPSTREAM) if case[0] == "ant" else (slow, WARP)
        )
        for case in PLAIN
    ),
]


@pytest.mark.parametrize(("physics", "name", "version"), CASES)
def test_one_step_agrees_with_gymnasium(physics, name, version):
    env = dg.make_env(name, physics=physics, version=version)
    assert isinstance(env, Env)
    ours = taken(env, *visited(name))
    terms = sum(ours.metrics[term] for term in GYM_TASKS[name].TERMS)
    assert_allclose(ours.reward, terms, rtol=1e-5, atol=1e-5)
    assert_steps_agree(ours, gymnasium_task(name, version), visited(name))


@pytest.mark.slow
@pytest.mark.parametrize("version", ["v4", "v5"])
@pytest.mark.parametrize("physics", ["mjx", pytest.param("mjx-warp", marks=WARP)])
def test_most_of_ants_steps_in_mjx_agree_with_gymnasium(physics, version):
    # all that MJX's contact tangent allows: see UPSTREAM
    poses, gym = tuple(x[::4] for x in visited("ant")), gymnasium_task("ant", version)
    ours = taken(dg.make_env("ant", physics=physics, version=version), *poses)
    error, same = [], []
    for i, (qpos, qvel, action) in enumerate(zip(*poses, strict=True)):
        gym.reset()
        gym.set_state(qpos.astype(float), qvel.astype(float))
        obs, reward, terminated, *_ = gym.step(action)
        error.append(max(np.abs(obs - ours.obs[i]).max(), abs(reward - ours.reward[i])))
        same.append(bool(ours.done[i]) == terminated)
    assert ours.obs.shape[1:] == gym.observation_space.shape
    assert np.median(error) < 5e-3
    assert np.mean(same) > 0.97
    gym.close()


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("hopper", 0.1, 0.9), ("walker2d", 0.1, 0.9), ("ant", 0.001, 0.5), ("swimmer", -1, 0.001)],
)
def test_the_comparison_sees_both_healthy_and_terminated_steps(name, low, high):
    assert (
        low < float(taken(dg.make_env(name, physics="native"), *visited(name)).done.mean()) < high
    )


PARAMETERS = [
    ("hopper", {"forward_reward_weight": 2.0, "ctrl_cost_weight": 0.5, "healthy_reward": 3.0}),
    ("hopper", {"terminate_when_unhealthy": False}),
    (
        "hopper",
        {
            "healthy_z_range": (1.2, 1.3),
            "healthy_angle_range": (-0.05, 0.05),
            "healthy_state_range": (-5.0, 5.0),
        },
    ),
    ("hopper", {"exclude_current_positions_from_observation": False}),
    (
        "walker2d",
        {
            "healthy_z_range": (1.0, 1.3),
            "healthy_angle_range": (-0.1, 0.5),
            "ctrl_cost_weight": 0.1,
        },
    ),
    (
        "swimmer",
        {
            "exclude_current_positions_from_observation": False,
            "forward_reward_weight": 3.0,
            "ctrl_cost_weight": 0.1,
        },
    ),
    (
        "ant",
        {
            "healthy_z_range": (0.4, 0.6),
            "ctrl_cost_weight": 0.1,
            "exclude_current_positions_from_observation": False,
        },
    ),
    (
        "ant",
        {"contact_cost_weight": 0.1, "contact_force_range": (-0.5, 0.2), "healthy_reward": 2.0},
    ),
]


@pytest.mark.parametrize("version", ["v4", "v5"])
@pytest.mark.parametrize(("name", "parameters"), PARAMETERS)
def test_task_parameters_mean_what_they_mean_in_gymnasium(name, parameters, version):
    poses = tuple(x[::8] for x in visited(name))
    env, gym = (
        dg.make_env(name, physics="native", version=version, **parameters),
        gymnasium_task(name, version, **parameters),
    )
    ours = taken(env, *poses)
    assert ours.obs.shape[1:] == gym.observation_space.shape == (env.observation_size,)
    assert_steps_agree(ours, gym, poses, reward=3e-3)


@pytest.mark.parametrize(
    ("version", "parameters"),
    [("v4", {"use_contact_forces": True}), ("v5", {"include_cfrc_ext_in_observation": False})],
)
def test_ant_observes_contact_forces_where_the_version_and_its_flag_say_so(version, parameters):
    poses = tuple(x[::8] for x in visited("ant"))
    env = dg.make_env("ant", physics="native", version=version, **parameters)
    assert env.observation_size == (111 if version == "v4" else 27)
    assert_steps_agree(taken(env, *poses), gymnasium_task("ant", version, **parameters), poses)


@pytest.mark.parametrize(("name", "version"), PLAIN)
def test_constants_are_gymnasiums(name, version):
    gym, env = gymnasium_task(name, version), dg.make_env(name, physics="native", version=version)
    theirs = {
        k: p.default
        for k, p in inspect.signature(type(gym).__init__).parameters.items()
        if p.default is not p.empty
    }
    ours = {}
    for cls in reversed(type(env).__mro__):
        if issubclass(cls, Env) and "__init__" in vars(cls):
            parameters = inspect.signature(cls.__init__).parameters
            ours |= {k: p.default for k, p in parameters.items() if p.default is not p.empty}
    for key in set(theirs) - {"xml_file", "frame_skip", "default_camera_config", "main_body"}:
        assert ours[key] == theirs[key], key
    assert gym.frame_skip == env.FRAME_SKIP
    assert env.FILE[version] == gym.fullpath.rsplit("/", 1)[-1]
    assert env.dt == pytest.approx(gym.dt)
    low, high = env.action_range
    assert_allclose(low, gym.action_space.low)
    assert_allclose(high, gym.action_space.high)
    gym.close()


def test_the_control_cost_takes_the_action_as_given():
    env = dg.make_env("hopper", physics="native")
    state = jax.jit(env.reset)(jax.random.key(0))
    inside, outside = (jax.jit(env.step)(state, jnp.full(3, a)) for a in (1.0, 2.0))
    assert_array_equal(inside.obs, outside.obs)
    assert_allclose(outside.metrics["reward_ctrl"], -1e-3 * 12)


@pytest.mark.parametrize(
    ("name", "scale"), [("hopper", 5e-3), ("walker2d", 5e-3), ("swimmer", 0.1), ("ant", 0.1)]
)
def test_resets_scatter_around_the_initial_pose_as_gymnasiums_do(name, scale):
    env = dg.make_env(name, physics="native")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 4_000)).pipeline_state
    position, velocity = (
        np.asarray(states.qpos) - np.asarray(env._init_qpos),
        np.asarray(states.qvel),
    )
    assert np.abs(position).max() <= scale * (1 + 1e-3)
    assert_allclose(position.std(0), scale / 3**0.5, rtol=0.06)
    assert_allclose(velocity.std(0), scale if name == "ant" else scale / 3**0.5, rtol=0.06)
    assert (np.abs(velocity).max() > scale * 1.5) == (name == "ant")
    assert len(np.unique(position[:, 1])) > 3_500


def test_resets_accept_the_legacy_keys_of_braxs_own_trainers():
    env = dg.make_env("hopper", physics="native")
    assert jnp.isfinite(jax.jit(env.reset)(jax.random.PRNGKey(0)).obs).all()


def test_hoppers_observation_clips_velocities_at_ten_and_swimmers_does_not():
    hopper, swimmer = (dg.make_env(name, physics="native") for name in ("hopper", "swimmer"))
    state = hopper.set_state(
        hopper.reset(jax.random.key(0)), jnp.zeros(6), jnp.array([-20.0, 20, 3, 0, 0, 0])
    )
    assert_allclose(state.obs[5:8], [-10, 10, 3])
    state = swimmer.set_state(
        swimmer.reset(jax.random.key(0)), jnp.zeros(5), jnp.array([-20.0, 20, 3, 0, 0])
    )
    assert_allclose(state.obs[3:6], [-20, 20, 3])


def test_braxs_own_wrappers_run_the_task():
    env = brax.envs.training.wrap(dg.make_env("hopper", physics="native"), episode_length=1000)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 4))
    state = jax.jit(env.step)(state, jnp.zeros((4, 3)))
    assert state.obs.shape == (4, 11)


@pytest.mark.slow
def test_braxs_own_trainer_trains_on_a_task(monkeypatch):
    from brax.training.agents.ppo import train as ppo

    import dgae_jax.envs.brax  # noqa: F401

    def replicated(
        tree, devices
    ):  # Brax 0.14 calls this function of JAX's, which JAX 0.10 no longer has
        return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)

    monkeypatch.setattr(jax, "device_put_replicated", replicated, raising=False)
    seen = []
    ppo.train(
        environment=brax.envs.get_environment("dgae_hopper", physics="jax"),
        num_timesteps=60_000, episode_length=200, num_envs=32, num_eval_envs=8, num_evals=2, unroll_length=10, batch_size=32,
        num_minibatches=8, num_updates_per_batch=4, learning_rate=3e-4, normalize_observations=True, seed=0,
        progress_fn=lambda steps, metrics: seen.append((steps, float(metrics["eval/episode_reward"]))),
    )  # fmt: skip
    assert seen[-1][0] >= 60_000
    assert seen[-1][1] > 2 * seen[0][1]
