"""stable-baselines3 on our tasks; where it is installed (extra `bench`)."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import dgae_jax as dg

pytest.importorskip("stable_baselines3")

import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecMonitor  # pyright: ignore[reportMissingImports]

from dgae_jax.export.sb3 import Sb3VecEnv


def hoppers(num_envs, **options):
    return dg.make_vector_env(
        "hopper", num_envs, physics="native", **{"autoreset_mode": "SameStep", **options}
    )


def test_an_end_is_told_as_stable_baselines3_expects_it():
    plain, env = (hoppers(3, max_episode_steps=20) for _ in range(2))
    env = Sb3VecEnv(env)
    env.seed(5)
    assert_array_equal(env.reset(), plain.reset(seed=5)[0])
    assert env.observation_space.shape == (11,)
    assert env.get_attr("render_mode", [0, 1]) == [None, None]
    rng, falls, limits = np.random.default_rng(0), 0, 0
    for _ in range(60):
        action = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        obs, reward, done, infos = env.step(action)
        true_obs, true_reward, terminated, truncated, true_infos = plain.step(action)
        assert_array_equal(obs, true_obs)
        assert_array_equal(reward, true_reward.astype(np.float32))
        assert_array_equal(done, terminated | truncated)
        for i, info in enumerate(infos):
            own = true_infos["final_info"] if done[i] else true_infos
            assert info["x_position"] == own["x_position"][i] != 0
            assert info["TimeLimit.truncated"] == (truncated[i] and not terminated[i])
            assert ("terminal_observation" in info) == done[i]
            if done[i]:
                assert_array_equal(info["terminal_observation"], true_infos["final_obs"][i])
        falls, limits = falls + terminated.sum(), limits + (truncated & ~terminated).sum()
    assert min(falls, limits) > 0


@pytest.mark.slow
def test_ppo_of_stable_baselines3_learns_to_hop():
    """A random policy has a return of 15, the trained one 194."""
    torch.set_num_threads(1)
    env = VecMonitor(Sb3VecEnv(hoppers(16)))
    model = PPO(
        "MlpPolicy", env, n_steps=128, batch_size=256, learning_rate=1e-3, seed=0, device="cpu"
    )
    model.learn(26_624)
    assert np.mean([episode["r"] for episode in model.ep_info_buffer]) > 100
