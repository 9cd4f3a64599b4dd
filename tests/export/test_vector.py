"""Our tasks as Gymnasium's vector environments, beside Gymnasium's own."""

import functools
import os
import re
import subprocess
import sys
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from brax.envs.wrappers.training import EpisodeWrapper
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.envs.registry import given
from dgae_jax.export import gl
from dgae_jax.physics.registry import ENGINES
from tests.helpers import GYM_TASKS
from tests.parity import WARP
from tests.probes import Counter

MODES = [mode.value for mode in AutoresetMode]


@functools.cache
def hoppers(mode="NextStep", num_envs=3, limit=20):
    """Compiled once; whoever takes them resets them."""
    return dg.make_vector_env(
        "hopper", num_envs, physics="native", autoreset_mode=mode, max_episode_steps=limit
    )


def actions_of(env, dtype=np.float32):
    rng = np.random.default_rng(0)
    while True:
        yield rng.uniform(-1, 1, env.action_space.shape).astype(dtype)


class Placed(gymnasium.Wrapper):
    """Gymnasium's task, whose resets take the pose [qpos, qvel] that is laid down."""

    pose = None

    def reset(self, **options):
        _, info = self.env.reset(**options)
        self.unwrapped.set_state(*self.pose)
        return self.unwrapped._get_obs(), info


def gymnasiums_own(name, version, mode, num_envs, limit):
    def make():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that v4 is not the latest version is known
            return Placed(
                gymnasium.make(f"{GYM_TASKS[name].NAME}-{version}", max_episode_steps=limit)
            )

    return SyncVectorEnv([make] * num_envs, autoreset_mode=mode)


def lay_down(theirs, ours):
    """Where our worlds are, for the resets of theirs."""
    physics = ours.state.pipeline_state
    for env, *pose in zip(theirs.envs, np.array(physics.qpos), np.array(physics.qvel), strict=True):
        env.pose = pose


SAID_OTHERWISE = {"distance_from_origin", "z_distance_from_origin", "forward_reward", "reward_fwd"}
"""Names of Gymnasium's that repeat another, or follow from one."""


def assert_infos_agree(ours, theirs, version):
    """What Gymnasium says, we say, as arrays of the same kind; only v5 says something at a reset too."""
    assert {
        name.removeprefix("_") for name in set(theirs) - set(ours)
    } <= SAID_OTHERWISE or version == "v5"
    for name in set(theirs) & set(ours):
        mask = ours.get(f"_{name}")
        if name.startswith("_"):
            assert ours[name].dtype == theirs[name].dtype == bool
            assert_array_equal(
                ours[name], theirs[name] & ours[name] if version == "v5" else theirs[name]
            )
        elif isinstance(theirs[name], dict):
            assert_infos_agree(ours[name], theirs[name], version)
        elif name == "final_obs":
            assert ours[name].dtype == theirs[name].dtype == object
            assert (
                [x is None for x in ours[name]] == [x is None for x in theirs[name]] == list(~mask)
            )
            assert_allclose(
                np.stack(ours[name][mask]), np.stack(theirs[name][mask]), rtol=1e-10, atol=1e-10
            )
        else:
            assert ours[name].dtype == theirs[name].dtype
            late = (
                version == "v5"
                and "reward_contact" in ours
                and name in ("x_position", "y_position")
            )  # the reward's, not the last
            assert_allclose(
                ours[name][mask],
                theirs[name][mask],
                rtol=1e-10,
                atol=1e-2 if late else 1e-10,
                err_msg=name,
            )
            assert not ours[name][~mask].any()


def assert_steps_agree(ours, theirs, version):
    for mine, yours in zip(ours[:4], theirs[:4], strict=True):
        assert (mine.dtype, mine.shape) == (yours.dtype, yours.shape)
        assert mine.flags.writeable
        assert_allclose(mine, yours, rtol=1e-10, atol=1e-10)
    assert_infos_agree(ours[4], theirs[4], version)


CASES = [
    pytest.param(name, version, mode, marks=() if (name, version) == ("hopper", "v4") and mode != "Disabled" else pytest.mark.slow)
    for name in GYM_TASKS for version in ("v4", "v5") for mode in MODES
]  # fmt: skip


@pytest.mark.parametrize(("name", "version", "mode"), CASES)
def test_in_float64_native_is_gymnasiums_own_vector_environment_through_ends_of_episodes(
    name, version, mode
):
    count, limit, falls, limits = 3, 20, 0, 0
    with jax.enable_x64(True):
        ours = dg.make_vector_env(
            name,
            count,
            physics="native",
            version=version,
            autoreset_mode=mode,
            max_episode_steps=limit,
        )
        theirs = gymnasiums_own(name, version, mode, count, limit)
        assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
        for space in (
            "observation_space",
            "action_space",
            "single_observation_space",
            "single_action_space",
        ):
            assert getattr(ours, space) == getattr(theirs, space)
        obs, _ = ours.reset(seed=0)
        lay_down(theirs, ours)
        assert_array_equal(theirs.reset()[0], obs)
        for _, action in zip(range(45), actions_of(ours, np.float64), strict=False):
            step = ours.step(action)
            lay_down(theirs, ours)
            assert_steps_agree(step, theirs.step(action), version)
            falls, limits = falls + step[2].sum(), limits + step[3].sum()
            if mode == "Disabled" and (mask := step[2] | step[3]).any():
                obs, _ = ours.reset(options={"reset_mask": mask})
                lay_down(theirs, ours)
                assert_allclose(
                    theirs.reset(options={"reset_mask": mask})[0], obs, rtol=1e-10, atol=1e-10
                )
        theirs.close()
    assert limits >= count
    assert falls > 0 or name != "hopper"


def played(env, steps, **reset):
    return [
        env.reset(**reset)[0],
        *(env.step(action)[:4] for _, action in zip(range(steps), actions_of(env), strict=False)),
    ]


def test_equal_seeds_give_equal_bits_and_others_others():
    env = hoppers()
    first, again, listed, other = (played(env, 25, seed=seed) for seed in (7, 7, [7, 8, 9], 8))
    jax.tree.map(assert_array_equal, first, again)
    jax.tree.map(assert_array_equal, first, listed)
    assert_array_equal(first[0][1:], other[0][:2])
    assert (first[0][0] != other[0][0]).all()


def test_a_world_goes_on_from_its_own_seed_whatever_the_others_do():
    env = hoppers("Disabled")
    first, second, third = env.reset(seed=[3, 4, 5])[0], env.reset()[0], env.reset()[0]
    assert len(np.unique(np.concatenate([first, second, third]), axis=0)) == 9
    env.reset(seed=[9, 4, 9])
    assert env.np_random_seed == (9, 4, 9)
    only = env.reset(options={"reset_mask": np.array([False, True, False])})[0]
    assert_array_equal(only[1], second[1])
    assert (only[[0, 2]] != second[[0, 2]]).all()
    assert_array_equal(env.reset(seed=[None, None, 5])[0][1:], [third[1], first[2]])


def test_an_automatic_reset_begins_where_a_reset_by_hand_would():
    env = hoppers("SameStep")
    env.reset(seed=0)
    by_hand, began = env.reset()[0], np.full(3, False)
    env.reset(seed=0)
    for _, action in zip(range(20), actions_of(env), strict=False):
        obs, _, terminated, truncated, _ = env.step(action)
        first = (terminated | truncated) & ~began
        assert_allclose(obs[first], by_hand[first], rtol=1e-10, atol=1e-10)
        began |= first
    assert began.all()


def test_worlds_are_moved_to_poses():
    env = hoppers()
    env.reset(seed=0)
    qpos, qvel = np.arange(18.0).reshape(3, 6) / 8, np.full((3, 6), 20.0)
    assert_array_equal(
        env.set_state(qpos, qvel), np.concatenate([qpos[:, 1:], np.full((3, 6), 10.0)], axis=1)
    )
    assert_array_equal(env.state.pipeline_state.qvel, qvel)


def test_a_world_that_turns_non_finite_ends_its_episode_and_is_reported():
    env = hoppers()
    before, _ = env.reset(seed=0)
    bad = np.zeros(env.action_space.shape, np.float32)
    bad[1] = np.nan
    obs, reward, terminated, truncated, infos = env.step(bad)
    assert terminated.tolist() == infos["nonfinite"].tolist() == [False, True, False]
    assert not truncated.any()
    assert (reward[1], infos["x_velocity"][1]) == (0, 0)
    assert_array_equal(obs[1], before[1])
    obs, _, terminated, _, infos = env.step(np.zeros_like(bad))
    assert np.isfinite(obs).all()
    assert not terminated.any()
    assert infos["_nonfinite"].tolist() == [True, False, True]


class OneWorld(gymnasium.Env):
    """A single environment of Gymnasium's over a vector of one."""

    def __init__(self):
        self.vector = hoppers("Disabled", num_envs=1)
        self.observation_space, self.action_space = (
            self.vector.single_observation_space,
            self.vector.single_action_space,
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        obs, _ = self.vector.reset(seed=seed, options=options)
        return obs[0], {}

    def step(self, action):
        obs, reward, terminated, truncated, infos = self.vector.step(action[None])
        return (
            obs[0],
            reward[0],
            bool(terminated[0]),
            bool(truncated[0]),
            {name: x[0] for name, x in infos.items()},
        )


def test_one_world_passes_gymnasiums_checks():
    env = OneWorld()
    env.spec = EnvSpec("OneWorld-v0", entry_point=OneWorld)  # with one, equal seeds are checked too
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(env)
    assert [
        each.message for each in said if "infinity" not in str(each.message)
    ] == []  # observations have no bounds, as Gymnasium's


def test_gymnasiums_wrappers_count_and_normalise_over_it():
    env = NormalizeObservation(RecordEpisodeStatistics(hoppers()))
    env.reset(seed=0)
    lengths, seen = [], []
    for _, action in zip(range(60), actions_of(env), strict=False):
        obs, _, terminated, truncated, infos = env.step(action)
        seen.append(obs)
        lengths += (
            infos["episode"]["l"][terminated | truncated].tolist() if "episode" in infos else []
        )
    assert len(lengths) >= 6
    assert set(range(1, 21)) >= set(lengths)
    assert np.abs(np.mean(seen[30:], axis=(0, 1))).max() < 1


def test_gymnasium_makes_it_by_name_with_its_time_limit():
    env = gymnasium.make_vec(
        "dgae_jax.export.vector:dgae_jax/Hopper-v5",
        num_envs=2,
        physics="native",
        healthy_reward=3.0,
    )
    assert (env.spec.id, env.num_envs, env.spec.kwargs["max_episode_steps"]) == (
        "dgae_jax/Hopper-v5",
        2,
        1000,
    )
    assert env.env.dt == 0.008
    assert env.env._healthy_reward == 3
    assert {
        f"dgae_jax/{task.NAME}-{v}" for task in GYM_TASKS.values() for v in ("v4", "v5")
    } <= set(gymnasium.registry)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "hoper"}, "environment hoper: must be one of ant"),
        ({"physics": "bullet"}, "physics bullet: must be one of jax"),
        ({"num_envs": 0}, "num_envs 0: must be a whole number of at least 1"),
        ({"max_episode_steps": 0}, "max_episode_steps 0: must be a whole number of at least 1"),
        (
            {"autoreset_mode": "Never"},
            "autoreset_mode Never: must be one of NextStep, SameStep, Disabled",
        ),
        (
            {"render_mode": "human"},
            "render_mode human: must be left out, or rgb_array with ant, hopper",
        ),
    ],
)
def test_what_cannot_be_made_is_refused_with_what_can(options, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        dg.make_vector_env(**{"name": "hopper", "num_envs": 2, "physics": "native", **options})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": -1}, "seed -1: must be a number of at least 0"),
        ({"seed": [1, 2]}, "seed [1, 2]: must be a number of at least 0, or 3 of them"),
        ({"seed": [1, 2, 0.5]}, "seed [1, 2, 0.5]: must be"),
        ({"options": {"pose": 1}}, "options 'pose': must be reset_mask, or left out"),
        (
            {"options": {"reset_mask": np.array([True])}},
            "reset_mask [ True]: must be 3 booleans, one of them true",
        ),
        ({"options": {"reset_mask": np.zeros(3, bool)}}, "reset_mask [False False False]: must be"),
        ({"options": {"reset_mask": np.ones(3)}}, "reset_mask [1. 1. 1.]: must be"),
    ],
)
def test_a_reset_that_does_not_fit_is_refused(options, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        hoppers().reset(**options)


def test_what_comes_at_the_wrong_time_is_refused():
    env = dg.make_vector_env(
        "hopper", 3, physics="native", autoreset_mode="Disabled", max_episode_steps=1
    )
    still = np.zeros((3, 3), np.float32)
    with pytest.raises(ResetNeeded, match="must be reset before"):
        env.step(still)
    with pytest.raises(ResetNeeded, match="the first reset is one of all worlds"):
        env.reset(options={"reset_mask": np.array([True, False, False])})
    env.reset()
    with pytest.raises(ValueError, match=r"^actions of shape \(3, 2\): must be of shape \(3, 3\)"):
        env.step(still[:, :2])
    env.step(still)
    env.reset(options={"reset_mask": np.array([False, True, False])})
    with pytest.raises(ResetNeeded, match=r"worlds \[0, 2\] are at the end of an episode"):
        env.step(still)
    env.close()
    with pytest.raises(ClosedEnvironmentError):
        env.reset()


def test_the_public_names_are_there_before_gymnasium_is_imported():
    program = "import sys, dgae_jax; assert 'make_vector_env' in dir(dgae_jax); assert 'gymnasium' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "physics", [pytest.param(name, marks=WARP if name == "mjx-warp" else ()) for name in ENGINES]
)
def test_every_engine_steps_as_native_does(physics):
    ours, native = (
        dg.make_vector_env("hopper", 2, physics=name, version="v5") for name in (physics, "native")
    )
    for env in (ours, native):
        env.reset(seed=0)
    for _, action in zip(range(5), actions_of(ours), strict=False):
        assert_steps_agree_loosely(ours.step(action), native.step(action))


def assert_steps_agree_loosely(ours, native):
    for mine, other in zip(ours[:4], native[:4], strict=True):
        assert mine.dtype == other.dtype
        assert_allclose(mine, other, atol=1e-3)
    assert ours[4].keys() == native[4].keys()


@pytest.mark.slow
def test_pictures_of_all_worlds():
    backend = next((name for name in gl.CANDIDATES if gl.draws(name)), None)
    if backend is None:
        pytest.skip(f"neither {' nor '.join(gl.CANDIDATES)} draws a picture here")
    program = """
import dgae_jax as dg
env = dg.make_vector_env("walker2d", 2, physics="native", render_mode="rgb_array", max_episode_steps=4)
env.reset(seed=0)
one, two = env.render()
assert one.shape == two.shape == (480, 480, 3)
assert one.std() > 10 and (one != two).any()
env.close()
"""
    subprocess.run(
        [sys.executable, "-c", program], check=True, env={**os.environ, gl.VARIABLE: backend}
    )


def test_a_time_limit_of_the_tasks_own_is_a_truncation():
    with given(EpisodeWrapper(Counter(), 5, 1)) as name:
        envs = dg.make_vector_env(name, 2)
    envs.reset(seed=0)
    ends = [envs.step(np.zeros((2, 1)))[2:4] for _ in range(5)]
    assert not np.any([terminated for terminated, _ in ends])
    assert_array_equal([truncated for _, truncated in ends], [[False] * 2] * 4 + [[True] * 2])
    assert envs.metadata["render_modes"] == []


def test_tasks_that_live_on_the_host_are_refused():
    with pytest.raises(
        ValueError,
        match=r"name gymnasium:Pendulum-v1: must be a task in JAX; gymnasium\.make_vec makes those of Gymnasium",
    ):
        dg.make_vector_env("gymnasium:Pendulum-v1", 2)
