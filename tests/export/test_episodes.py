"""Episodes with what came after, against Gymnasium itself."""

import dataclasses
import warnings

import gymnasium
import numpy as np
import pytest

from dgae_jax.export import episodes
from dgae_jax.export.episodes import Actor, play, returns_from
from dgae_jax.run.evaluation import episode_seeds
from tests.runs import small


class Still:
    """A policy that holds one action, and a critic of four crossing quantiles."""

    def __init__(self, action):
        self.action = np.array(action, np.float32)

    def __call__(self, obs):
        return self.action

    def quantiles(self, obs):
        return np.broadcast_to(np.array([3.0, 1.0, 4.0, 2.0], np.float32), (len(obs), 4))


def actor(env="hopper", action=(0.1, -0.2, 0.3), std=2.0, **changes):
    settings = {"env": env, "gamma": 0.9, "episode_length": 1000, **changes}
    return Actor("name", Still(action), dataclasses.replace(small("dppo"), **settings), std)


def alone(env, action, number, steps):
    """Rewards and positions of the same episode."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        world = gymnasium.make(env, max_episode_steps=10_000)
    world.reset(seed=number)
    rewards, qpos = [], []
    for _ in range(steps):
        qpos.append(world.unwrapped.data.qpos.copy())
        _, reward, terminated, _, _ = world.step(np.array(action, np.float32))
        rewards.append(reward)
        if terminated:
            break
    world.close()
    return np.array(rewards), np.array(qpos)


def test_the_return_from_a_state_on_is_a_geometric_sum():
    gamma, count = 0.9, 12
    want = [(1 - gamma ** (count - t)) / (1 - gamma) for t in range(count)]
    np.testing.assert_allclose(returns_from([1.0] * count, gamma), want)


def test_an_episode_that_ends_by_a_fall_is_the_one_that_gymnasium_plays():
    number = int(episode_seeds(3, 1)[0])
    episode, (rewards, qpos) = (
        play(actor(), number, 10.0),
        alone("Hopper-v4", (0.1, -0.2, 0.3), number, 1000),
    )
    assert episode.fell
    assert 5 < len(rewards) < 1000
    np.testing.assert_array_equal(episode.qpos, qpos)
    np.testing.assert_allclose(episode.total, np.cumsum(rewards) - rewards)
    want = [sum(0.9**k * r for k, r in enumerate(rewards[t:])) / 2 for t in range(len(rewards))]
    np.testing.assert_allclose(episode.came, want)


def test_what_is_cut_off_is_played_on_unseen_until_it_does_not_count():
    episode = play(actor("swimmer", (0.5, -0.5)), 7, 0.4)
    rewards, qpos = alone("Swimmer-v4", (0.5, -0.5), 7, 10 + 44)  # 0.9⁴³ > 1 % ≥ 0.9⁴⁴
    assert (len(episode.qpos), episode.dt, episode.fell) == (10, 0.04, False)
    np.testing.assert_array_equal(episode.qpos, qpos[:10])
    want = [sum(0.9**k * r for k, r in enumerate(rewards[t:])) / 2 for t in range(10)]
    np.testing.assert_allclose(episode.came, want)


def test_quantiles_are_sorted_and_valued_by_the_preference_of_the_run():
    for metric, value in (("mean", 2.5), ("cvar:0.5", 1.5), ("cvar:0.25", 1.0)):
        episode = play(actor(metric=metric), 7, 0.1)
        np.testing.assert_array_equal(episode.quantiles, [[1, 2, 3, 4]] * len(episode.qpos))
        np.testing.assert_allclose(episode.value, value)


@pytest.mark.parametrize(
    ("limit", "seconds", "states"), [(5, 10.0, 5), (1000, 0.08, 2), (1000, 1e-6, 1)]
)
def test_an_episode_is_shown_up_to_its_time_limit_or_so_many_seconds(limit, seconds, states):
    assert len(play(actor("swimmer", (0, 0), episode_length=limit), 7, seconds).qpos) == states


def test_scenes_are_the_initial_states_of_an_evaluation(monkeypatch):
    played = []
    monkeypatch.setattr(
        episodes, "play", lambda actor, number, seconds: played.append((actor, number, seconds))
    )
    list(episodes._played(["a", "b"], episodes.Shots(2, 5, 1.0)))
    first, second = (int(n) for n in episode_seeds(5, 2))
    assert played == [("a", first, 1.0), ("b", first, 1.0), ("a", second, 1.0), ("b", second, 1.0)]


def test_a_far_sighted_return_is_followed_for_longer_than_an_episode():
    episode = play(actor("swimmer", (0.5, -0.5), gamma=0.999, episode_length=100), 7, 0.04)
    rewards, _ = alone("Swimmer-v4", (0.5, -0.5), 7, 1 + 4603)  # ln 0.01 / ln 0.999 = 4602.9
    np.testing.assert_allclose(episode.came, [sum(0.999**k * r for k, r in enumerate(rewards)) / 2])
