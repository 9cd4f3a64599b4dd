import dataclasses
from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.configs.build import make_greedy, make_trainer, seed_keys
from dgae_jax.learn import normalizers
from tests.helpers import SMALL, small
from tests.probes import Coin, Constant, Delayed, Fragile, Target


@cache
def hopper(algo):
    config = small(algo)
    env = dg.make_env("hopper", physics="native")
    return config, make_trainer(env, 4)


def fresh(trainer, config):
    return trainer.init(config, seed_keys(config))


def assert_same_bits(a, b):
    chex.assert_trees_all_equal(
        *(jax.tree.map(lambda x: jax.random.key_data(x) if x.dtype == seed_keys(SMALL).dtype else x, t) for t in (a, b))
    )


@pytest.mark.parametrize("algo", ["ppo", "dppo"])
def test_same_key_same_bits_whatever_the_number_of_iterations_per_dispatch(algo):
    config, trainer = hopper(algo)
    together, rows = trainer.dispatch(config, fresh(trainer, config), 3)
    apart = fresh(trainer, config)
    for i in range(3):
        apart, row = trainer.dispatch(config, apart, 1)
        chex.assert_trees_all_equal(jax.tree.map(lambda x, i=i: x[i], rows), jax.tree.map(lambda x: x[0], row))
    assert_same_bits(together, apart)
    assert int(together.iteration[0]) == 3


@pytest.mark.parametrize("algo", ["ppo", "dppo", "dtrpo", "da2c"])
def test_metrics_are_finite_and_the_iteration_learns_from_every_sample(algo):
    config, trainer = hopper(algo)
    _, rows = trainer.dispatch(config, fresh(trainer, config), 4)
    for name, column in rows.items():
        assert column.shape == (4, 1)
        if not name.startswith("episode_"):
            assert jnp.isfinite(column).all(), name


def test_the_train_step_is_traced_once_whatever_the_count_the_floats_and_the_seed():
    config, _ = hopper("dppo")
    env = dg.make_env("hopper", physics="native")
    trainer = make_trainer(env, 4)
    counted = jax.jit(chex.assert_max_traces(trainer.dispatch.__wrapped__, n=1))
    state = fresh(trainer, config)
    for count, gamma, rate in ((1, 0.99, 3e-4), (3, 0.9, 1e-3), (2, 0.5, 1e-2)):
        config = dataclasses.replace(config, gamma=gamma, policy=dataclasses.replace(config.policy, learning_rate=rate))
        state, _ = counted(config, state, count)
    assert int(state.iteration[0]) == 6


def test_the_compiled_programs_of_a_run_are_one_for_init_and_one_for_all_dispatches():
    config, _ = hopper("ppo")
    trainer = make_trainer(dg.make_env("hopper", physics="native"), 4)
    state = fresh(trainer, config)
    for count in (1, 4, 2):
        state, _ = trainer.dispatch(config, state, count)
    assert trainer.init._cache_size() == 1
    assert trainer.dispatch._cache_size() == 1


def test_floats_of_the_configuration_may_be_swept_in_one_program():
    env = Target()
    rates = jnp.array([1e-4, 1e-2])

    @jax.jit
    @jax.vmap
    def moved(rate):
        config = small("ppo")
        config = dataclasses.replace(config, policy=dataclasses.replace(config.policy, learning_rate=rate))
        init, step = dg.make_train(dg.make_algorithm("ppo", env, config), env, config)
        state = init(jax.random.key(0))
        after, _ = step(state)
        return sum(
            jnp.abs(a - b).sum() for a, b in zip(jax.tree.leaves(after.policy.params), jax.tree.leaves(state.policy.params), strict=True)
        )

    slow, fast = moved(rates)
    assert 10 * slow < fast


def test_a_seed_trained_beside_others_is_the_run_alone_up_to_rounding():
    # bit for bit at the start; then a batched matrix product may round differently from a single one
    config, trainer = hopper("ppo")
    three, alone = dataclasses.replace(config, num_seeds=3, seed=5), dataclasses.replace(config, seed=6)
    beside, single = fresh(trainer, three), fresh(trainer, alone)
    assert_same_bits(jax.tree.map(lambda x: x[1:2], beside), single)
    beside, _ = trainer.dispatch(three, beside, 2)
    single, _ = trainer.dispatch(alone, single, 2)
    for ours, theirs in zip(jax.tree.leaves(beside.policy.params), jax.tree.leaves(single.policy.params), strict=True):
        assert_allclose(ours[1], theirs[0], atol=1e-5)


ALL = ["ppo", "dppo", "trpo", "dtrpo", "a2c", "da2c"]


def learn(env, algo, iterations, **changes):
    fit = {"hidden": (16,), "epochs": 4, "minibatches": 4, "learning_rate": 3e-3, "learning_rate_end": 1.0}
    policy = {**fit, "epochs": 1, "minibatches": 1, "learning_rate": 3e-2} if "a2c" in algo else fit
    policy = {"hidden": (16,)} if "trpo" in algo else policy
    quantiles = {"quantiles": 8} if algo.startswith("d") else {}
    critic = dg.CriticConfig(**fit, **quantiles, **changes.pop("critic", {}))
    config = dg.Config(
        algo=algo, num_envs=32, horizon=8, total_steps=256 * iterations, policy=dg.PolicyConfig(**policy), critic=critic, **changes
    )
    trainer = make_trainer(env, iterations)
    state, rows = trainer.dispatch(config, trainer.init(config, seed_keys(config)), iterations)
    return config, jax.tree.map(lambda x: x[0], state), rows


@pytest.mark.parametrize("algo", ALL)
def test_the_policy_finds_the_best_action_for_each_observation(algo):
    env = Target()
    config, state, _ = learn(env, algo, 40)
    greedy = make_greedy(env, config)
    assert_allclose(greedy(state, jnp.array([[-1.0], [1.0]])), [[-0.5], [0.5]], atol=0.1)


@pytest.mark.parametrize("target", ["lambda-return", "sr-lambda", "lambda-shift", "bellman"])
@pytest.mark.parametrize("algo", ["ppo", "dppo"])
def test_the_critic_finds_the_value_of_a_constant_reward(algo, target):
    # V = 1 / (1 - ½) = 2, also across time limits, which do not end the bootstrap
    off = {"normalize_rewards": False, "normalize_observations": False}
    _, _, rows = learn(Constant(), algo, 60, gamma=0.5, episode_length=5, critic={"target": target}, **off)
    assert_allclose(rows["critic/value"][-1, 0], 2.0, atol=0.05)


@pytest.mark.parametrize("algo", ["ppo", "da2c"])
def test_the_critic_finds_values_that_are_paid_later(algo):
    off = {"normalize_rewards": False, "normalize_observations": False}
    env = Delayed()
    config, state, _ = learn(env, algo, 80, gamma=0.5, **off)
    critic = dg.make_algorithm(algo, env, config).critic
    assert_allclose(critic.predict(state.critic.params, jnp.eye(3)).mean(-1), [2, 4, 8], atol=0.3)


def test_a_distributional_critic_finds_the_distribution_of_a_noisy_reward():
    off = {"normalize_rewards": False, "normalize_observations": False}
    env = Coin()
    config, state, rows = learn(env, "dtrpo", 80, critic={"kappa": 0.05}, diagnostics=True, **off)
    quantiles = dg.make_algorithm("dtrpo", env, config).critic.predict(state.critic.params, jnp.ones(1))
    assert_allclose(jnp.sort(quantiles), [-1] * 4 + [1] * 4, atol=0.35)
    assert_allclose(rows["critic/wasserstein"][-1, 0], 1.0, atol=0.25)  # half of its mass is 2 away from either outcome
    assert rows["critic/similar_means"].shape == (80, 1)


@pytest.mark.parametrize("where", ["state", "reward", "observation"])
def test_a_world_that_turns_non_finite_is_counted_and_reaches_neither_normaliser_nor_critic_nor_policy(where):
    _, state, rows = learn(Fragile(where, jnp.nan), "dppo", 4, episode_length=6)
    assert (rows["nonfinite"][:, 0] > 0).all()
    for part in (state.policy, state.critic, state.observations, state.returns):
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(part))
    for name, column in rows.items():
        assert np.isfinite(column).all(), name


def test_reward_scaling_divides_by_the_deviation_of_the_discounted_return(key):
    reward = jax.random.normal(key, (50, 3)) + 1
    done = jax.random.bernoulli(key, 0.1, (50, 3)).astype(jnp.float32)
    scale, scaled = normalizers.rescale(normalizers.return_scale(3), reward, done, 0.9)
    trail, running = np.zeros((50, 3)), np.zeros(3)
    for t in range(50):
        running = 0.9 * running + np.asarray(reward[t])
        trail[t], running = running, running * (1 - np.asarray(done[t]))
    assert_allclose(scaled, np.asarray(reward) / trail.std(), rtol=1e-4)
    assert_allclose(scale.discounted, running, rtol=1e-4)


def test_observation_statistics_are_those_of_all_samples_seen(key):
    obs = 3 * jax.random.normal(key, (4, 10, 5, 2)) + 7
    state = normalizers.observations(2)
    assert_array_equal(normalizers.normalize(state, obs[0]), jnp.clip(obs[0], -10, 10))
    for rollout in obs:
        state = normalizers.observe(state, rollout, jnp.ones((10, 5), bool))
    assert isinstance(state, running_statistics.RunningStatisticsState)
    flat = np.asarray(obs).reshape(-1, 2)
    assert_allclose(normalizers.normalize(state, obs[0]), (np.asarray(obs[0]) - flat.mean(0)) / flat.std(0), rtol=1e-3, atol=1e-4)


def test_the_ratio_is_one_before_the_first_step_because_statistics_are_frozen_across_rollout_and_update():
    # one epoch of one minibatch looks at the batch once, at the policy that acted
    config, trainer = hopper("ppo")
    once = dataclasses.replace(config, policy=dataclasses.replace(config.policy, epochs=1, minibatches=1))
    _, rows = trainer.dispatch(once, fresh(trainer, once), 3)
    assert_allclose(rows["policy/kl"][:3], 0, atol=1e-6)
    assert_array_equal(rows["policy/clip_fraction"][:3], 0)
