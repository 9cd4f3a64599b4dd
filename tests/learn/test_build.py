"""Registered parts, refusals, and the settings that are leaves of a program."""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
import pytest
from numpy.testing import assert_allclose

import dgae_jax as dg
from dgae_jax.configs.parts import CRITICS, SGD
from dgae_jax.learn import build
from dgae_jax.learn.critics import Target, quantile_critic
from dgae_jax.learn.networks import SharedCovariance
from dgae_jax.learn.updates import minibatch_update, surrogate
from tests import probes
from tests.helpers import small


@pytest.fixture
def tables():
    """Undo what a test registers."""
    before = [(table, dict(table)) for pair in build.TABLES.values() for table in pair]
    yield
    for table, entries in before:
        table.clear()
        table.update(entries)


def iterate(config):
    """The states before and after one iteration, and its metrics."""
    env = probes.Target()
    init, train_step = dg.make_train(dg.make_algorithm(config.algo, env, config), env, config)
    before = jax.jit(init)(jax.random.key(0))
    return before, *jax.jit(train_step)(before)


@pytest.mark.parametrize("kind", build.TABLES)
def test_names_are_checked_against_the_functions_that_exist(kind):
    names, functions = build.TABLES[kind]
    assert set(names) == set(functions)


class Swish(nn.Module):
    """Hidden layers that are not tanh."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, x):
        for width in self.hidden:
            x = nn.swish(nn.Dense(width, name=f"wide_{width}")(x))
        return x


def reward_only(key, reward, discount, trace, quantiles, next_quantiles):
    return reward[..., None] + 0 * next_quantiles


def kl_penalty(policy, iterations, **fit):
    def loss(params, batch):
        value, info = surrogate(policy)(params, batch)
        return value + info["kl"], info

    return minibatch_update(loss, iterations, **fit)


def test_registered_parts_of_every_kind_are_chosen_by_name_and_used(tables):
    dg.register("covariance", "swish", partial(SharedCovariance, torso=Swish))
    dg.register("critic", "swish", partial(quantile_critic, torso=Swish), CRITICS["quantile"])
    dg.register("optimizer", "lion", optax.lion)
    dg.register("target", "reward", Target(reward_only))
    dg.register("update", "kl-penalty", kl_penalty, SGD)
    changes = {
        "diagnostics": True,
        "policy.update": "kl-penalty",
        "policy.covariance": "swish",
        "policy.optimizer": "lion",
        "policy.learning_rate": 0.01,
        "policy.minibatches": 1,
        "policy.epochs": 1,
        "critic.kind": "swish",
        "critic.target": "reward",
        "critic.hidden": (6, 5),
    }
    before, after, metrics = iterate(small("dppo").replace(**changes))
    assert sorted(before.policy.params["params"]["Swish_0"]) == ["wide_8"]
    assert sorted(before.critic.params["params"]["Swish_0"]) == ["wide_5", "wide_6"]
    assert before.critic.params["params"]["Dense_0"]["kernel"].shape == (5, 8)
    assert jnp.isfinite(metrics["critic/loss"])
    moved = after.policy.params["params"]["log_std"] - before.policy.params["params"]["log_std"]
    assert_allclose(jnp.abs(moved), 0.01, rtol=1e-3)  # a step of Lion is one learning rate long


def test_an_invalid_configuration_or_that_of_another_algorithm_is_refused():
    env, config = probes.Target(), dg.Config(gamma=1.5)
    with pytest.raises(dg.ConfigError, match=r"^gamma 1.5: must be a number from 0 to 1"):
        dg.make_train(dg.make_algorithm("dppo", env, dg.Config()), env, config)
    with pytest.raises(dg.ConfigError, match=r"^algo dppo: must be ppo or unset$"):
        dg.make_algorithm("ppo", env, dg.Config(algo="dppo"))
    with pytest.raises(dg.ConfigError, match=r"^algo sac: must be one of ppo, dppo"):
        dg.make_algorithm("sac", env, dg.Config())


@pytest.mark.parametrize("resolved", [False, True])
def test_leaves_of_a_configuration_are_its_floats_and_its_budget(resolved):
    config = small("dppo").replace(**{"policy.clip_eps": 0.2, "critic.kappa": 1.0})
    config = dg.resolve(config) if resolved else config
    paths = jax.tree.leaves_with_path(config)
    leaves = {jax.tree_util.keystr(p, simple=True, separator="."): leaf for p, leaf in paths}
    assert {name for name, leaf in leaves.items() if type(leaf) is not float} == {"total_steps"}
    assert {"gamma", "gae_lambda", "total_steps", "policy.initial_std"} <= set(leaves)
    assert config.get("critic.hidden") not in leaves.values()


def test_floats_are_swept_in_one_compiled_program():
    env = probes.Target()

    @jax.jit
    @jax.vmap
    def moved(rate, gamma):
        config = small("ppo").replace(**{"policy.learning_rate": rate, "gamma": gamma})
        init, step = dg.make_train(dg.make_algorithm("ppo", env, config), env, config)
        before = init(jax.random.key(0))
        after, _ = step(before)
        steps = jax.tree.map(lambda a, b: jnp.abs(a - b).sum(), after.policy, before.policy)
        return sum(jax.tree.leaves(steps.params))

    slow, fast = moved(jnp.array([1e-4, 1e-2]), jnp.array([0.9, 0.99]))
    assert 10 * slow < fast
