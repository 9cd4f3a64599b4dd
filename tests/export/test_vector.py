"""Our tasks as vector environments, beside Gymnasium's own."""

import functools
import itertools
import os
import subprocess
import sys
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from brax.envs.wrappers.training import EpisodeWrapper
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.envs.gym_tasks import GYM_TASKS
from dgae_jax.envs.registry import custom_env
from dgae_jax.export import gl
from tests.probes import Counter

CLOSE = functools.partial(assert_allclose, rtol=1e-10, atol=1e-10)


@functools.cache
def hoppers(mode="NextStep", num_envs=3, limit=20):
    """Compiled once; each test resets them."""
    return dg.make_vector_env(
        "hopper", num_envs, physics="native", autoreset_mode=mode, max_episode_steps=limit
    )


def random_actions(env, count, dtype=np.float32):
    rng = np.random.default_rng(0)
    return [rng.uniform(-1, 1, env.action_space.shape).astype(dtype) for _ in range(count)]


class Placed(gymnasium.Wrapper):
    """Gymnasium's task with resets to the pose [qpos, qvel] in `pose`."""

    pose = None

    def reset(self, **options):
        _, info = self.env.reset(**options)
        self.unwrapped.set_state(*self.pose)
        return self.unwrapped._get_obs(), info


def gymnasiums_own(name, version, mode, num_envs, limit):
    def make():
        return Placed(gymnasium.make(f"{GYM_TASKS[name].NAME}-{version}", max_episode_steps=limit))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that v4 is not the latest version is known
        return SyncVectorEnv([make] * num_envs, autoreset_mode=mode)


def place(theirs, ours):
    """Let the resets of Gymnasium's envs take the poses of ours."""
    physics = ours.state.pipeline_state
    for env, *pose in zip(theirs.envs, np.array(physics.qpos), np.array(physics.qvel), strict=True):
        env.pose = pose


LEFT_OUT = {"distance_from_origin", "z_distance_from_origin", "forward_reward", "reward_fwd"}
"""Infos of Gymnasium that repeat another, or follow from one."""


def assert_infos_agree(ours, theirs, version):
    """Compare infos; only v5 has some at a reset too."""
    missing = {name.removeprefix("_") for name in set(theirs) - set(ours)}
    assert missing <= LEFT_OUT or version == "v5"
    for name in set(theirs) & set(ours):
        mask = ours.get(f"_{name}")
        if isinstance(theirs[name], dict):
            assert_infos_agree(ours[name], theirs[name], version)
            continue
        assert ours[name].dtype == theirs[name].dtype
        if name.startswith("_"):
            assert_array_equal(ours[name], theirs[name] & (ours[name] | (version != "v5")))
        elif name == "final_obs":
            assert [x is None for x in ours[name]] == list(~mask)
            CLOSE(np.stack(ours[name][mask]), np.stack(theirs[name][mask]))
        else:
            # v5 Ant reports the last position, ours is the one that the reward is computed from
            is_late = version == "v5" and "reward_contact" in ours and name.endswith("_position")
            CLOSE(ours[name][mask], theirs[name][mask], atol=1e-2 if is_late else 1e-10)
            assert not ours[name][~mask].any()


QUICK = {("hopper", "v4", "NextStep"), ("hopper", "v4", "SameStep")}
CASES = [
    pytest.param(*case, marks=[] if case in QUICK else pytest.mark.slow)
    for case in itertools.product(GYM_TASKS, ("v4", "v5"), [mode.value for mode in AutoresetMode])
]


@pytest.mark.parametrize(("name", "version", "mode"), CASES)
def test_native_in_float64_equals_gymnasium(name, version, mode):
    count, limit, falls, limits = 3, 20, 0, 0
    with jax.enable_x64(True):
        options = {"version": version, "autoreset_mode": mode, "max_episode_steps": limit}
        ours = dg.make_vector_env(name, count, physics="native", **options)
        theirs = gymnasiums_own(name, version, mode, count, limit)
        assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
        assert ours.observation_space == theirs.observation_space
        assert ours.single_action_space == theirs.single_action_space
        obs, _ = ours.reset(seed=0)
        place(theirs, ours)
        assert_array_equal(theirs.reset()[0], obs)
        for action in random_actions(ours, 45, np.float64):
            step = ours.step(action)
            place(theirs, ours)
            expected = theirs.step(action)
            for mine, yours in zip(step[:4], expected[:4], strict=True):
                assert (mine.dtype, mine.shape) == (yours.dtype, yours.shape)
                assert mine.flags.writeable
                CLOSE(mine, yours)
            assert_infos_agree(step[4], expected[4], version)
            falls, limits = falls + step[2].sum(), limits + step[3].sum()
            if mode == "Disabled" and (mask := step[2] | step[3]).any():
                obs, _ = ours.reset(options={"reset_mask": mask})
                place(theirs, ours)
                CLOSE(theirs.reset(options={"reset_mask": mask})[0], obs)
        theirs.close()
    assert limits >= count
    assert falls > 0 or name != "hopper"


def test_each_env_has_its_own_random_stream():
    env, mask = hoppers("Disabled"), np.array([False, True, False])
    obs = env.reset(seed=7)[0]
    assert_array_equal(env.reset(seed=[7, 8, 9])[0], obs)
    assert_array_equal(env.reset(seed=8)[0][:2], obs[1:])
    first, second, third = env.reset(seed=[3, 4, 5])[0], env.reset()[0], env.reset()[0]
    assert len(np.unique(np.concatenate([first, second, third]), axis=0)) == 9
    env.reset(seed=[9, 4, 9])
    assert_array_equal(env.reset(options={"reset_mask": mask})[0][1], second[1])
    assert_array_equal(env.reset(seed=[None, None, 5])[0][1:], [third[1], first[2]])


def test_set_state_moves_every_env():
    env = hoppers()
    env.reset(seed=0)
    qpos, qvel = np.arange(18.0).reshape(3, 6) / 8, np.full((3, 6), 20.0)
    expected = np.concatenate([qpos[:, 1:], np.full((3, 6), 10.0)], axis=1)
    assert_array_equal(env.set_state(qpos, qvel), expected)
    assert_array_equal(env.state.pipeline_state.qvel, qvel)


def test_nonfinite_env_terminates_and_is_reported():
    env = hoppers()
    before, _ = env.reset(seed=0)
    bad = np.zeros(env.action_space.shape, np.float32)
    bad[1] = np.nan
    obs, reward, terminated, truncated, infos = env.step(bad)
    assert terminated.tolist() == infos["nonfinite"].tolist() == [False, True, False]
    assert not truncated.any()
    assert (reward[1], infos["x_velocity"][1]) == (0, 0)
    assert_array_equal(obs[1], before[1])
    assert np.isfinite(env.step(np.zeros_like(bad))[0]).all()


def test_gymnasium_makes_it_by_name():
    name = "dgae_jax.export.vector:dgae_jax/Hopper-v5"
    env = gymnasium.make_vec(name, num_envs=2, physics="native", healthy_reward=3.0)
    assert (env.spec.id, env.num_envs) == ("dgae_jax/Hopper-v5", 2)
    assert env.spec.kwargs["max_episode_steps"] == 1000
    assert (env.env.dt, env.env.healthy_reward) == (0.008, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "hoper"}, "environment hoper: must be one of ant"),
        ({"num_envs": 0}, "num_envs 0: must be at least 1"),
        ({"autoreset_mode": "Never"}, "'Never' is not a valid AutoresetMode"),
        ({"render_mode": "human"}, "render_mode human: must be left out, or rgb_array"),
        ({"name": "gymnasium:Pendulum-v1", "physics": None}, "name gymnasium:.*a task in JAX"),
    ],
)
def test_invalid_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        dg.make_vector_env(**{"name": "hopper", "num_envs": 2, "physics": "native", **options})


def test_invalid_steps_and_resets_are_refused():
    env = hoppers("Disabled", limit=1)
    still = np.zeros((3, 3), np.float32)
    with pytest.raises(ResetNeeded, match=r"envs \[0 1 2\] are in no episode"):
        env.step(still)
    with pytest.raises(ValueError, match=r"seed \[1, 2\]: must be a number, or a list of 3"):
        env.reset(seed=[1, 2])
    with pytest.raises(ValueError, match=r"reset_mask .*: must be 3 booleans"):
        env.reset(options={"reset_mask": np.ones(3)})
    env.reset()
    with pytest.raises(ValueError, match=r"^actions of \(3, 2\): must be of shape \(3, 3\)"):
        env.step(still[:, :2])
    env.step(still)
    env.reset(options={"reset_mask": np.array([False, True, False])})
    with pytest.raises(ResetNeeded, match=r"envs \[0 2\] are in no episode"):
        env.step(still)


@pytest.mark.slow
def test_render_draws_every_env(opengl):
    program = """
import dgae_jax as dg
env = dg.make_vector_env("walker2d", 2, physics="native", render_mode="rgb_array")
env.reset(seed=0)
one, two = env.render()
assert one.shape == two.shape == (480, 480, 3) and one.std() > 10 and (one != two).any()
env.close()
"""
    environment = {**os.environ, gl.VARIABLE: opengl}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)


def test_the_tasks_own_time_limit_truncates():
    with custom_env(EpisodeWrapper(Counter(), 5, 1)) as name:
        envs = dg.make_vector_env(name, 2)
    envs.reset(seed=0)
    ends = [envs.step(np.zeros((2, 1)))[2:4] for _ in range(5)]
    assert_array_equal(ends, [[[False] * 2] * 2] * 4 + [[[False] * 2, [True] * 2]])
