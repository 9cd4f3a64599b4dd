import itertools
import json
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
import pytest

import dgae_jax as dg
from dgae_jax.configs.algorithms import ALGORITHMS, Row
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.parts import (
    COVARIANCES,
    CRITICS,
    DESCENT,
    OPTIMIZERS,
    RESIDUALS,
    TARGETS,
    UPDATES,
    Part,
)
from dgae_jax.configs.presets import PRESETS
from dgae_jax.configs.resolved import resolve
from dgae_jax.configs.serial import from_dict, to_dict
from dgae_jax.envs.registry import TASKS
from dgae_jax.learn import critics
from dgae_jax.learn.networks import SharedCovariance
from dgae_jax.learn.updates import descend, surrogate
from tests.probes import Target


def test_every_row_names_parts_that_exist():
    for row in ALGORITHMS.values():
        assert row.critic in CRITICS
        assert row.residual in RESIDUALS
        assert row.target in TARGETS
        assert row.policy_update in UPDATES


def test_a_distributional_variant_differs_from_its_baseline_in_critic_residual_and_target_only():
    for name in ("ppo", "trpo", "a2c"):
        baseline, variant = ALGORITHMS[name], ALGORITHMS["d" + name]
        assert variant == Row("quantile", "distributional", "sr-lambda", baseline.policy_update)
        assert baseline == Row("scalar", "td", "lambda-return", baseline.policy_update)


def test_parts_named_in_the_configuration_take_the_place_of_the_rows():
    config = dg.preset("tuned", "ppo", "hopper", update="trust-region")
    config = resolve(
        dg.Config(
            algo="ppo",
            residual="distributional",
            policy=config.policy,
            critic=dg.CriticConfig(kind="quantile"),
        )
    )
    assert (config.residual, config.critic.kind, config.critic.target) == (
        "distributional",
        "quantile",
        "lambda-return",
    )


@pytest.mark.parametrize(
    ("name", "algo", "env"), list(itertools.product(PRESETS, ALGORITHMS, TASKS))
)
def test_presets_are_valid(name, algo, env):
    config = dg.preset(name, algo, env)
    resolve(config)
    assert (config.algo, config.env) == (algo, env)


@pytest.mark.parametrize("env", TASKS)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_paper_preset_has_the_papers_networks_budgets_and_rollouts(algo, env):
    config, ant = dg.preset("paper", algo, env), env == "ant"
    assert config.policy.hidden == config.critic.hidden == ((512, 512) if ant else (256, 256))
    assert config.total_steps == (10_000_000 if env in ("ant", "hopper") else 5_000_000)
    assert config.critic.quantiles == (64 if ALGORITHMS[algo].critic == "quantile" else None)
    rollouts = {"clip": (4096, 2048), "trust-region": (50_000, 25_000), "gradient": (80, 80)}
    assert config.samples_per_iteration == rollouts[ALGORITHMS[algo].policy_update][0 if ant else 1]


@pytest.mark.parametrize("update", UPDATES)
def test_any_update_may_be_asked_of_any_algorithm(update):
    for algo in ALGORITHMS:
        config = dg.preset("tuned", algo, "hopper", update=update)
        resolve(
            dg.Config(
                **{
                    **vars(config),
                    "policy": dg.PolicyConfig(**{**vars(config.policy), "update": update}),
                }
            )
        )


def test_a_seventh_row_joins_the_table_and_trains(monkeypatch):
    def cautious(policy, iterations, **fit):
        def loss(params, batch):
            value, info = surrogate(policy)(params, batch)
            return value + info["kl"], info

        return descend(loss, iterations, **fit)

    monkeypatch.setitem(UPDATES, "kl-penalty", Part(cautious, DESCENT))
    monkeypatch.setitem(
        ALGORITHMS, "mine", Row("quantile", "distributional", "lambda-shift", "kl-penalty")
    )
    fit = {"hidden": (8,), "epochs": 1, "minibatches": 1}
    config = dg.Config(
        algo="mine",
        num_envs=4,
        num_steps=4,
        total_steps=64,
        policy=dg.PolicyConfig(**fit),
        critic=dg.CriticConfig(**fit, quantiles=4),
    )
    resolve(config)
    init, train_step = dg.make_train(dg.make_algorithm("mine", Target(), config), Target(), config)
    before = jax.jit(init)(jax.random.key(0))
    after, metrics = jax.jit(train_step)(before)
    assert jnp.isfinite(metrics["policy/loss"])
    moved = jax.tree.map(
        lambda a, b: jnp.abs(a - b).max(), before.policy.params, after.policy.params
    )
    assert max(jax.tree.leaves(moved)) > 0


class Swish(nn.Module):
    """Hidden layers that are not tanh."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, x):
        for width in self.hidden:
            x = nn.swish(nn.Dense(width, name=f"wide_{width}")(x))
        return x


def test_networks_optimisers_and_targets_of_ones_own_are_chosen_by_name_and_used(monkeypatch):
    one_step = critics.Target(
        lambda key, reward, discount, trace, z, z_next: reward[..., None] + 0 * z_next
    )
    monkeypatch.setitem(COVARIANCES, "swish", Part(partial(SharedCovariance, torso=Swish)))
    monkeypatch.setitem(
        CRITICS, "swish", Part(partial(critics.quantile, torso=Swish), CRITICS["quantile"].options)
    )
    monkeypatch.setitem(OPTIMIZERS, "lion", Part(optax.lion))
    monkeypatch.setitem(TARGETS, "reward", Part(one_step))
    policy = dg.PolicyConfig(
        hidden=(8,),
        covariance="swish",
        optimizer="lion",
        learning_rate=0.01,
        minibatches=1,
        epochs=1,
    )
    critic = dg.CriticConfig(
        hidden=(6, 5), kind="swish", target="reward", quantiles=4, minibatches=1
    )
    config = dg.Config(
        algo="dppo",
        num_envs=4,
        num_steps=4,
        total_steps=64,
        policy=policy,
        critic=critic,
        metric="cvar:0.5",
        diagnostics=True,
    )
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config
    env = Target()
    algorithm = dg.make_algorithm("dppo", env, config)
    init, train_step = dg.make_train(algorithm, env, config)
    before = jax.jit(init)(jax.random.key(0))
    after, metrics = jax.jit(train_step)(before)
    assert sorted(before.policy.params["params"]["Swish_0"]) == ["wide_8"]
    assert sorted(before.critic.params["params"]["Swish_0"]) == ["wide_5", "wide_6"]
    assert before.critic.params["params"]["Dense_0"]["kernel"].shape == (5, 4)
    assert jnp.isfinite(metrics["critic/loss"])
    moved = jnp.abs(
        after.policy.params["params"]["log_std"] - before.policy.params["params"]["log_std"]
    )
    assert jnp.allclose(moved, 0.01, rtol=1e-3)  # one step of Lion moves every number by the rate
    reward = jnp.arange(6.0).reshape(3, 2)
    assert (
        algorithm.critic.target(None, reward, reward, reward, None, jnp.ones((3, 2, 4)))
        == reward[..., None]
    ).all()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            dg.Config(policy=dg.PolicyConfig(covariance="swish")),
            "policy.covariance swish: must be one of shared, state",
        ),
        (
            dg.Config(critic=dg.CriticConfig(kind="swish")),
            "critic.kind swish: must be one of scalar, quantile",
        ),
        (
            dg.Config(critic=dg.CriticConfig(target="reward")),
            "critic.target reward: must be one of bellman, ",
        ),
        (
            dg.Config(policy=dg.PolicyConfig(optimizer="lion")),
            "policy.optimizer lion: must be one of adam, rmsprop",
        ),
    ],
)
def test_a_part_that_is_not_in_its_table_is_refused_by_name(config, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        resolve(config)
