import dataclasses
from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.learn import iteration
from dgae_jax.learn.build import make_greedy, make_trainer, policies_of, seed_keys
from dgae_jax.learn.types import TrainableState, Update
from tests.helpers import SMALL, distance, small
from tests.probes import Coin, Constant, Counter, Delayed, Fragile, Target


@cache
def hopper(algo):
    config = small(algo)
    env = dg.make_env("hopper", physics="native")
    return config, make_trainer(env, 4)


def fresh(trainer, config):
    return trainer.init(config, seed_keys(config))


def assert_same_bits(a, b):
    chex.assert_trees_all_equal(
        *(
            jax.tree.map(
                lambda x: jax.random.key_data(x) if x.dtype == seed_keys(SMALL).dtype else x, t
            )
            for t in (a, b)
        )
    )


@pytest.mark.parametrize("algo", ["ppo", "dppo"])
def test_same_key_same_bits_whatever_the_number_of_iterations_per_dispatch(algo):
    config, trainer = hopper(algo)
    together, rows = trainer.dispatch(config, fresh(trainer, config), 3)
    apart = fresh(trainer, config)
    for i in range(3):
        apart, row = trainer.dispatch(config, apart, 1)
        chex.assert_trees_all_equal(
            jax.tree.map(lambda x, i=i: x[i], rows), jax.tree.map(lambda x: x[0], row)
        )
    assert_same_bits(together, apart)
    assert int(together.iteration[0]) == 3


def test_a_run_is_two_programs_whatever_the_count_and_the_floats():
    config, trainer = small("ppo"), make_trainer(Counter(), 4)
    state = fresh(trainer, config)
    for count, gamma, rate in ((1, 0.99, 3e-4), (4, 0.9, 1e-3), (2, 0.5, 1e-2)):
        policy = dataclasses.replace(config.policy, learning_rate=rate)
        state, _ = trainer.dispatch(
            dataclasses.replace(config, gamma=gamma, policy=policy), state, count
        )
    assert int(state.iteration[0]) == 7
    assert (trainer.init._cache_size(), trainer.dispatch._cache_size()) == (1, 1)


def test_floats_of_the_configuration_may_be_swept_in_one_program():
    env = Target()
    rates = jnp.array([1e-4, 1e-2])

    @jax.jit
    @jax.vmap
    def moved(rate):
        config = small("ppo")
        config = dataclasses.replace(
            config, policy=dataclasses.replace(config.policy, learning_rate=rate)
        )
        init, step = dg.make_train(dg.make_algorithm("ppo", env, config), env, config)
        state = init(jax.random.key(0))
        after, _ = step(state)
        return sum(
            jnp.abs(a - b).sum()
            for a, b in zip(
                jax.tree.leaves(after.policy.params),
                jax.tree.leaves(state.policy.params),
                strict=True,
            )
        )

    slow, fast = moved(rates)
    assert 10 * slow < fast


def test_a_seed_trained_beside_others_is_the_run_alone_up_to_rounding():
    # bit for bit at the start; then a batched matrix product may round differently from a single one
    config, trainer = hopper("ppo")
    three, alone = (
        dataclasses.replace(config, num_seeds=3, seed=5),
        dataclasses.replace(config, seed=6),
    )
    beside, single = fresh(trainer, three), fresh(trainer, alone)
    assert_same_bits(jax.tree.map(lambda x: x[1:2], beside), single)
    beside, _ = trainer.dispatch(three, beside, 2)
    single, _ = trainer.dispatch(alone, single, 2)
    for ours, theirs in zip(
        jax.tree.leaves(beside.policy.params), jax.tree.leaves(single.policy.params), strict=True
    ):
        assert_allclose(ours[1], theirs[0], atol=1e-5)


ALL = ["ppo", "dppo", "trpo", "dtrpo", "a2c", "da2c"]


def learn(env, algo, iterations, **changes):
    fit = {
        "hidden": (16,),
        "epochs": 4,
        "minibatches": 4,
        "learning_rate": 3e-3,
        "learning_rate_end": 1.0,
    }
    policy = {**fit, "epochs": 1, "minibatches": 1, "learning_rate": 3e-2} if "a2c" in algo else fit
    policy = {"hidden": (16,)} if "trpo" in algo else policy
    quantiles = {"quantiles": 8} if algo.startswith("d") else {}
    critic = dg.CriticConfig(**fit, **quantiles, **changes.pop("critic", {}))
    config = dg.Config(
        algo=algo,
        num_envs=32,
        num_steps=8,
        total_steps=256 * iterations,
        policy=dg.PolicyConfig(**policy),
        critic=critic,
        **changes,
    )
    trainer = make_trainer(env, iterations)
    state, rows = trainer.dispatch(config, trainer.init(config, seed_keys(config)), iterations)
    return config, jax.tree.map(lambda x: x[0], state), rows


@pytest.mark.parametrize("algo", ALL)
def test_the_policy_finds_the_best_action_for_each_observation(algo):
    env = Target()
    config, state, rows = learn(env, algo, 40)
    greedy = make_greedy(env, config)
    state = policies_of(state)
    assert_allclose(greedy(state, jnp.array([[-1.0], [1.0]])), [[-0.5], [0.5]], atol=0.1)
    for name, column in rows.items():
        assert column.shape == (40, 1)
        assert np.isfinite(column).all(), name


@pytest.mark.parametrize(
    ("algo", "target"),
    [
        ("ppo", "lambda-return"),
        ("dppo", "lambda-return"),
        ("dppo", "sr-lambda"),
        ("dppo", "lambda-shift"),
        ("dppo", "bellman"),
        ("dppo", "monte-carlo"),
    ],
)
def test_the_critic_finds_the_value_of_a_constant_reward(algo, target):
    # V = 1 / (1 - ½) = 2, also across time limits, which do not end the bootstrap
    off = {"normalize_rewards": False, "normalize_observations": False}
    _, _, rows = learn(
        Constant(), algo, 60, gamma=0.5, episode_length=5, critic={"target": target}, **off
    )
    assert_allclose(rows["critic/value"][-1, 0], 2.0, atol=0.05)


def test_monte_carlo_is_sr_lambda_with_a_lambda_of_1_for_the_critic_alone():
    def first(target, lam):
        _, state, _ = learn(Delayed(), "dppo", 1, lam=lam, critic={"target": target})
        return jax.tree.map(np.asarray, (state.critic.params, state.policy.params))

    critic, policy = first("monte-carlo", 0.5)
    same, _ = first("sr-lambda", 1.0)
    another, same_policy = first("sr-lambda", 0.5)
    jax.tree.map(np.testing.assert_array_equal, critic, same)
    jax.tree.map(np.testing.assert_array_equal, policy, same_policy)
    assert not all(
        np.array_equal(x, y)
        for x, y in zip(jax.tree.leaves(critic), jax.tree.leaves(another), strict=True)
    )


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
    quantiles = dg.make_algorithm("dtrpo", env, config).critic.predict(
        state.critic.params, jnp.ones(1)
    )
    assert_allclose(jnp.sort(quantiles), [-1] * 4 + [1] * 4, atol=0.35)
    assert_allclose(
        rows["critic/wasserstein"][-1, 0], 1.0, atol=0.25
    )  # half of its mass is 2 away from either outcome
    assert rows["critic/similar_means"].shape == (80, 1)


def test_a_world_that_turns_non_finite_is_counted_and_reaches_neither_normaliser_nor_critic_nor_policy():
    _, state, rows = learn(
        Fragile(jnp.nan, "pipeline_state", "reward", "obs"), "dppo", 4, episode_length=6
    )
    assert (rows["nonfinite"][:, 0] > 0).all()
    for part in (state.policy, state.critic, state.observations, state.reward_scale):
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(part))
    for name, column in rows.items():
        assert np.isfinite(column).all(), name


# ---- one iteration with a part of our own, which shows what the updates are handed ----


def iterate(env, iterations=1, *, observations=True, **parts):
    """States and metrics of a few iterations of PPO with some of its parts replaced; none of its networks moves by itself."""
    stay = Update(lambda params: (), lambda key, fit, batch: (fit, {"loss": jnp.zeros(())}))
    config = small("ppo")
    algorithm = dg.make_algorithm("ppo", env, config)._replace(
        **{"policy_update": stay, "critic_update": stay, **parts}
    )
    init, step = iteration.make_train(
        algorithm, env, num_envs=8, num_steps=3, episode_length=100, gamma=0.9, lam=0.9,
        normalize_observations=observations, normalize_rewards=False,
    )  # fmt: skip
    states, rows, step = [init(jax.random.key(0))], [], jax.jit(step)
    for _ in range(iterations):
        state, row = step(states[-1])
        states, rows = [*states, state], [*rows, row]
    return states, rows


def report(**measures):
    """An update that changes nothing and reports measures of the batch."""

    def step(key, fit, batch):
        return fit, {
            "loss": jnp.zeros(()),
            **{name: measure(batch) for name, measure in measures.items()},
        }

    return Update(lambda params: (), step)


def test_advantages_are_standardised_over_the_valid_steps_alone():
    seen = report(
        valid=lambda b: b.valid.sum(),
        mean=lambda b: b.advantage.mean(where=b.valid),
        std=lambda b: b.advantage.std(where=b.valid),
        others=lambda b: jnp.abs(jnp.where(b.valid, 0, b.advantage)).max(),
    )
    _, (row,) = iterate(Fragile(jnp.nan, "reward"), policy_update=seen)
    assert 0 < 3 * 8 - row["policy/valid"] == row["nonfinite"] < 8
    assert_allclose(
        [row["policy/mean"], row["policy/std"], row["policy/others"]], [0, 1, 0], atol=1e-5
    )


def test_the_ratio_is_one_before_the_first_step_because_statistics_are_frozen_across_rollout_and_update():
    # one epoch of one minibatch looks at the batch once, at the policy that acted
    once = small("ppo")
    once = dataclasses.replace(
        once, policy=dataclasses.replace(once.policy, epochs=1, minibatches=1)
    )
    states, rows = iterate(
        Counter(), 3, policy_update=dg.make_algorithm("ppo", Counter(), once).policy_update
    )
    assert_allclose([row["policy/kl"] for row in rows], 0, atol=1e-6)
    assert_array_equal([row["policy/clip_fraction"] for row in rows], 0)
    assert distance(states[-1].policy.params, states[0].policy.params) > 1e-4
    assert distance(states[-1].observations, states[0].observations) > 1


def test_observations_that_are_not_normalised_are_not_clipped_either():
    seen = report(largest=lambda b: b.obs.max(), next=lambda b: b.next_obs.max())
    states, rows = iterate(Counter(), 5, observations=False, policy_update=seen)
    assert states[-1].observations is None
    assert [float(row["policy/largest"]) for row in rows] == [2, 5, 8, 11, 14]
    assert rows[-1]["policy/next"] == 15


@pytest.mark.parametrize(("broken", "healthy"), [("policy", "critic"), ("critic", "policy")])
@pytest.mark.parametrize("what", ["parameters", "optimiser", "loss"])
def test_an_update_that_is_not_finite_is_left_out_and_the_other_is_not(broken, healthy, what):
    def spoil(key, fit, batch):
        params = jax.tree.map(lambda x: x + jnp.where(what == "parameters", jnp.nan, 1), fit.params)
        moments = jnp.where(what == "optimiser", jnp.inf, 1.0)
        return TrainableState(params, moments), {"loss": jnp.where(what == "loss", jnp.nan, 0.0)}

    def move(key, fit, batch):
        return TrainableState(jax.tree.map(lambda x: x + 1, fit.params), fit.opt_state), {
            "loss": jnp.zeros(())
        }

    start = jnp.zeros(())
    updates = {
        f"{broken}_update": Update(lambda params: start, spoil),
        f"{healthy}_update": Update(lambda params: (), move),
    }
    (before, *_, after), rows = iterate(Counter(), 2, **updates)
    chex.assert_trees_all_equal(getattr(after, broken), getattr(before, broken))
    chex.assert_trees_all_close(
        getattr(after, healthy).params,
        jax.tree.map(lambda x: x + 2, getattr(before, healthy).params),
    )
    assert [row["skipped"] for row in rows] == [1, 1]
    assert after.failures == 2


class Breaking(Counter):
    """Its reward is not a number in the given step of every episode."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(reward=jnp.where(after.obs[0] == self.at, jnp.nan, after.reward))


@pytest.mark.parametrize(
    ("at", "failures"),
    [
        (1, [1, 2, 3, 4]),  # every step is invalid
        (2, [0, 1, 0, 1]),  # of three steps one is invalid, then two, then one, …
        (3, [0, 0, 0, 0]),  # one of three
    ],
)
def test_an_iteration_in_which_more_than_half_of_the_steps_are_invalid_counts_as_a_failure(
    at, failures
):
    states, rows = iterate(Breaking(at), 4)
    assert [int(state.failures) for state in states[1:]] == failures
    assert all(row["skipped"] == 0 for row in rows)
