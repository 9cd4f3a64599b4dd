import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.learn.rollout import rollout, start
from tests.probes import Counter, Fragile


def act(key, obs):
    return jnp.full((*obs.shape[:-1], 1), 3.0), jnp.zeros(obs.shape[:-1])


def run(env, key, *, worlds=4, num_steps=12, episode_length=5):
    start_key, key = jax.random.split(key)
    return rollout(
        env,
        act,
        begin(env, start_key, worlds),
        jax.random.split(key, (num_steps, worlds)),
        episode_length=episode_length,
    )


def begin(env, key, worlds):
    return start(env, jax.random.split(key, worlds))


def test_a_time_limit_truncates_and_never_terminates(key):
    _, step = run(Counter(), key)
    assert not step.terminated.any()
    assert_array_equal(np.flatnonzero(step.truncated[:, 0]), [4, 9])


def test_the_end_of_the_task_terminates_and_never_truncates_even_on_the_last_step_allowed(key):
    _, step = run(Counter(length=5), key, episode_length=5)
    assert not step.truncated.any()
    assert_array_equal(np.flatnonzero(step.terminated[:, 0]), [4, 9])


def test_the_successor_at_an_episodes_end_is_where_it_ended_not_the_reset_observation(key):
    _, step = run(Counter(), key)
    assert_array_equal(step.next_obs[4, :, 0], 5)
    assert_array_equal(step.obs[5, :, 0], 0)
    assert_array_equal(step.next_obs[4, :, 1], step.obs[4, :, 1])


def test_every_episode_starts_afresh(key):
    _, step = run(Counter(), key)
    starts = np.asarray(step.obs[[0, 5, 10], :, 1]).ravel()
    assert len(set(starts.tolist())) == 12


def test_within_an_episode_the_successor_is_the_next_observation(key):
    _, step = run(Counter(), key)
    continues = ~np.asarray(step.truncated)[:-1]
    assert_array_equal(
        np.asarray(step.next_obs)[:-1][continues], np.asarray(step.obs)[1:][continues]
    )


def test_episode_returns_are_undiscounted_sums_and_unknown_before_the_first_end(key):
    episodes, _ = run(Counter(), key, num_steps=4)
    assert jnp.isnan(episodes.last_total).all()
    episodes, _ = run(Counter(), key, num_steps=7)
    assert_allclose(episodes.last_total, 1 + 2 + 3 + 4 + 5)
    assert_allclose(episodes.last_steps, 5)
    assert_allclose(episodes.total, 1 + 2)
    assert_array_equal(episodes.steps, 2)


def test_two_rollouts_in_a_row_are_one_long_rollout_in_episode_time(key):
    first, second = jax.random.split(key)
    env = Counter()
    episodes, a = rollout(
        env, act, begin(env, key, 3), jax.random.split(first, (7, 3)), episode_length=5
    )
    _, b = rollout(env, act, episodes, jax.random.split(second, (5, 3)), episode_length=5)
    assert_array_equal(jnp.concatenate([a.reward, b.reward])[:, 0], [1, 2, 3, 4, 5] * 2 + [1, 2])


def test_actions_are_clipped_before_they_act_and_recorded_as_sampled(key):
    episodes, step = run(Counter(), key)
    assert_array_equal(step.action, 3.0)
    assert_array_equal(episodes.env.metrics["action"][0], 1.0)


@pytest.mark.parametrize("value", [jnp.nan, jnp.inf])
@pytest.mark.parametrize("part", ["pipeline_state", "reward", "obs"])
def test_a_world_that_turns_non_finite_ends_terminated_without_reward_and_starts_afresh(
    part, value, key
):
    episodes, step = run(Fragile(value, part), key, worlds=16, num_steps=4, episode_length=100)
    broken = np.asarray(step.obs[0, :, 1] < 0.5)
    assert 0 < broken.sum() < 16
    assert_array_equal(step.terminated[2], broken)
    assert_array_equal(step.reward[2], np.where(broken, 0, 3))
    assert_array_equal(step.obs[3, :, 0], np.where(broken, 0, 3))
    assert_array_equal(episodes.last_total, np.where(broken, 1 + 2, np.nan))
    assert int(episodes.nonfinite.sum()) == broken.sum()
    assert all(np.isfinite(x).all() for x in step)
    assert all(
        np.isfinite(x).all() for x in (episodes.env.obs, episodes.env.reward, episodes.total)
    )


def test_a_non_finite_action_is_contained_too(key):
    def sometimes(key, obs):
        action = jnp.where((obs[:, :1] == 2) & (obs[:, 1:] < 0.5), jnp.nan, 0.5)
        return action, action[:, 0]

    start_key, key = jax.random.split(key)
    episodes, step = rollout(
        Counter(),
        sometimes,
        begin(Counter(), start_key, 16),
        jax.random.split(key, (4, 16)),
        episode_length=100,
    )
    assert 0 < int(episodes.nonfinite.sum()) == int(step.terminated[2].sum()) < 16
    assert all(np.isfinite(x).all() for x in step)
    assert_array_equal(jnp.isnan(episodes.incident[1][:, 0]), episodes.nonfinite > 0)


def test_a_state_broken_from_outside_reaches_no_step(key):
    episodes = begin(Counter(), key, 4)
    broken = episodes._replace(env=episodes.env.replace(obs=episodes.env.obs.at[1].set(jnp.nan)))
    episodes, step = rollout(
        Counter(), act, broken, jax.random.split(key, (3, 4)), episode_length=100
    )
    assert all(np.isfinite(x).all() for x in step)
    assert_array_equal(step.terminated[0], [False, True, False, False])
    assert int(episodes.nonfinite.sum()) == 1


def test_the_incident_of_a_world_is_the_state_before_and_the_action(key):
    episodes, _ = run(Fragile(jnp.nan, "reward"), key, worlds=16, num_steps=3, episode_length=100)
    state, action = episodes.incident
    broken = np.asarray(episodes.nonfinite) == 1
    assert 0 < broken.sum() < 16
    assert_array_equal(action[:, 0], np.where(broken, 3, 0))
    assert_array_equal(state, 0)
    healthy, _ = run(Counter(), key)
    assert int(healthy.nonfinite.sum()) == 0


def test_what_happens_in_a_world_depends_on_its_own_keys_alone(key):
    def drawn(keys, obs):
        return jax.vmap(jax.random.normal, (0, None))(keys, (1,)), jnp.zeros(len(keys))

    start_keys, keys = jax.random.split(key, 6), jax.random.split(key, (7, 6))
    whole, all_steps = rollout(
        Counter(), drawn, start(Counter(), start_keys), keys, episode_length=5
    )
    half, steps = rollout(
        Counter(), drawn, start(Counter(), start_keys[3:]), keys[:, 3:], episode_length=5
    )
    jax.tree.map(
        lambda a, b: assert_array_equal(a[3:], b),
        whole._replace(incident=()),
        half._replace(incident=()),
    )
    jax.tree.map(lambda a, b: assert_array_equal(a[:, 3:], b), all_steps, steps)
