"""Whole iterations: determinism, learning of known values, what updates are handed, failures."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import dgae_jax as dg
from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.learn.build import make_greedy, policies_of, seed_keys
from dgae_jax.learn.parallel import make_trainer
from dgae_jax.learn.types import Update
from tests.helpers import distance, small
from tests.probes import Constant, Counter, Fragile, Target


def init(trainer, config):
    return trainer.init(config, seed_keys(config))


def assert_same_bits(a, b):
    def plain(x):
        return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x

    chex.assert_trees_all_equal(*(jax.tree.map(plain, tree) for tree in (a, b)))


def test_results_do_not_depend_on_iterations_per_dispatch():
    trainer, config = make_trainer(Counter(), 4), dg.resolve(small("ppo"))
    together, rows = trainer.dispatch(config, init(trainer, config), 3)
    one_by_one = init(trainer, config)
    for i in range(3):
        one_by_one, row = trainer.dispatch(config, one_by_one, 1)
        for name in rows:
            assert_array_equal(rows[name][i], row[name][0])
    assert_same_bits(together, one_by_one)
    assert int(together.iteration[0]) == 3
    other = small("ppo").replace(**{"gamma": 0.5, "policy.learning_rate": 1e-2})
    trainer.dispatch(dg.resolve(other), together, 2)  # other floats need no other program
    assert (trainer.init._cache_size(), trainer.dispatch._cache_size()) == (1, 1)


def test_a_seed_among_others_is_the_single_run_up_to_rounding():
    # bit for bit at the start; then a batched matrix product may round differently
    trainer = make_trainer(Counter(), 2)
    three, single = (dg.resolve(small("dppo", num_seeds=n, seed=s)) for n, s in ((3, 5), (1, 6)))
    ours, theirs = init(trainer, three), init(trainer, single)
    assert_same_bits(jax.tree.map(lambda x: x[1:2], ours), theirs)
    ours, _ = trainer.dispatch(three, ours, 2)
    theirs, _ = trainer.dispatch(single, theirs, 2)
    second = jax.tree.map(lambda x: x[1:2], ours.policy.params)
    chex.assert_trees_all_close(second, theirs.policy.params, atol=1e-5)


# ---- learning of known values ----


def learn(env, algo, iterations, **changes):
    """The configuration, the state after so many iterations, and the metrics."""
    fit = {"epochs": 4, "minibatches": 4, "learning_rate": 3e-3, "learning_rate_end": 1.0}
    once = {**fit, "epochs": 1, "minibatches": 1, "learning_rate": 3e-2}
    by_update = {"clip": fit, "gradient": once, "trust-region": {}}
    policy = by_update[ALGORITHMS[algo].policy_update]
    quantiles = {"quantiles": 8} if algo.startswith("d") else {}
    config = dg.Config(
        algo=algo,
        num_envs=32,
        num_steps=8,
        total_steps=256 * iterations,
        policy=dg.PolicyConfig(hidden=(16,), **policy),
        critic=dg.CriticConfig(hidden=(16,), **fit, **quantiles),
    )
    config = dg.resolve(config.replace(**changes))
    trainer = make_trainer(env, iterations)
    state, rows = trainer.dispatch(config, init(trainer, config), iterations)
    return config, jax.tree.map(lambda x: x[0], state), rows


UNSCALED = {"normalize_rewards": False, "normalize_observations": False}
OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in ("ppo", "dtrpo", "a2c")]


@pytest.mark.parametrize("algo", ["dppo", "trpo", "da2c", *OTHERS])
def test_the_policy_finds_the_best_action_for_each_observation(algo):
    config, state, rows = learn(Target(), algo, 40)
    greedy = make_greedy(Target(), config)
    actions = greedy(policies_of(state), jnp.array([[-1.0], [1.0]]))
    assert_allclose(actions, [[-0.5], [0.5]], atol=0.1)
    for name, column in rows.items():
        assert column.shape == (40, 1)
        assert np.isfinite(column).all(), name


@pytest.mark.parametrize(("algo", "target"), [("ppo", "lambda-return"), ("dppo", "bellman")])
def test_the_critic_finds_the_value_of_a_constant_reward(algo, target):
    # V = 1 / (1 - ½) = 2, also across time limits, which do not end the bootstrap
    changes = {"gamma": 0.5, "episode_length": 5, "critic.target": target, **UNSCALED}
    _, _, rows = learn(Constant(), algo, 60, **changes)
    assert_allclose(rows["critic/value"][-1, 0], 2.0, atol=0.05)


def test_a_non_finite_env_reaches_no_statistic_and_no_network():
    env = Fragile(jnp.nan, "pipeline_state", "reward", "obs")
    _, state, rows = learn(env, "dppo", 4, episode_length=6)
    assert (rows["nonfinite"][:, 0] > 0).all()
    kept = state.policy, state.critic, state.obs_stats, state.reward_scale
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(kept))
    for name, column in rows.items():
        assert np.isfinite(column).all(), name


# ---- single iterations with a part of our own, which shows what the updates are handed ----


def stay(params):
    return ()


def report(**measures):
    """An update that changes nothing and reports measures of the batch."""

    def step(key, state, batch):
        measured = {name: measure(batch) for name, measure in measures.items()}
        return state, {"loss": jnp.zeros(()), **measured}

    return Update(stay, step)


def iterate(env, iterations=1, *, changes=(), algo="ppo", **parts):
    """States and metrics with some of the parts replaced; no network moves by itself."""
    config = small(algo, num_envs=8, num_steps=3, gamma=0.9, normalize_rewards=False)
    config = config.replace(**dict(changes))
    parts = {"policy_update": report(), "critic_update": report()} | parts
    algorithm = dg.make_algorithm(algo, env, config)._replace(**parts)
    start, step = dg.make_train(algorithm, env, config)
    states, rows, step = [jax.jit(start)(jax.random.key(0))], [], jax.jit(step)
    for _ in range(iterations):
        state, row = step(states[-1])
        states, rows = [*states, state], [*rows, row]
    return states, rows


def test_advantages_are_standardized_over_unmasked_steps():
    seen = report(
        count=lambda b: b.mask.sum(),
        mean=lambda b: b.advantage.mean(where=b.mask),
        std=lambda b: b.advantage.std(where=b.mask),
        others=lambda b: jnp.abs(jnp.where(b.mask, 0, b.advantage)).max(),
    )
    _, (row,) = iterate(Fragile(jnp.nan, "reward"), policy_update=seen)
    assert 0 < 3 * 8 - row["policy/count"] == row["nonfinite"] < 8
    got = [row[f"policy/{name}"] for name in ("mean", "std", "others")]
    assert_allclose(got, [0, 1, 0], atol=1e-5)


def test_the_target_may_have_a_lambda_of_its_own():
    critic = dg.make_algorithm("dppo", Counter(), small("dppo")).critic
    critic = critic._replace(target=lambda key, r, discount, trace, *_: trace[..., None], lam=1.0)
    seen = report(lam=lambda b: b.target.mean())
    _, (row,) = iterate(Counter(), algo="dppo", critic=critic, critic_update=seen)
    assert row["critic/lam"] == 1.0


def test_statistics_are_frozen_across_rollout_and_update():
    # one epoch of one minibatch looks at the batch once, with the policy that acted: ρ = 1
    once = small("ppo").replace(**{"policy.epochs": 1, "policy.minibatches": 1})
    update = dg.make_algorithm("ppo", Counter(), once).policy_update
    states, rows = iterate(Counter(), 2, policy_update=update)
    assert_allclose([row["policy/kl"] for row in rows], 0, atol=1e-6)
    assert_array_equal([row["policy/clip_fraction"] for row in rows], 0)
    assert distance(states[-1].policy.params, states[0].policy.params) > 1e-4
    assert distance(states[-1].obs_stats, states[0].obs_stats) > 1


@pytest.mark.parametrize(
    ("broken", "healthy", "what"),
    [("policy", "critic", "parameters"), ("critic", "policy", "loss")],
)
def test_a_non_finite_update_is_skipped_and_the_other_is_not(broken, healthy, what):
    def spoil(key, state, batch):
        params = jax.tree.map(lambda x: x + (jnp.nan if what == "parameters" else 1), state.params)
        return state._replace(params=params), {
            "loss": jnp.array(0.0 if what != "loss" else jnp.nan)
        }

    def move(key, state, batch):
        params = jax.tree.map(lambda x: x + 1, state.params)
        return state._replace(params=params), {"loss": jnp.zeros(())}

    updates = {f"{broken}_update": Update(stay, spoil), f"{healthy}_update": Update(stay, move)}
    (before, *_, after), rows = iterate(Counter(), 2, **updates)
    chex.assert_trees_all_equal(getattr(after, broken), getattr(before, broken))
    want = jax.tree.map(lambda x: x + 2, getattr(before, healthy).params)
    chex.assert_trees_all_close(getattr(after, healthy).params, want)
    assert [row["skipped"] for row in rows] == [1, 1]
    assert after.failures == 2


class Breaking(Counter):
    """Its reward is NaN at the given step of every episode."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(reward=jnp.where(after.obs[0] == self.at, jnp.nan, after.reward))


def test_an_iteration_with_most_steps_masked_counts_as_a_failure():
    for at, failures in ((1, [1, 2, 3]), (2, [0, 1, 0])):  # all masked; of three one, two, one, …
        states, rows = iterate(Breaking(at), 3)
        assert [int(state.failures) for state in states[1:]] == failures
        assert all(row["skipped"] == 0 for row in rows)
