import itertools

import jax
import jax.numpy as jnp
import pytest

import dgae_jax as dg
from dgae_jax.configs.algorithms import TABLE, Row
from dgae_jax.configs.config import resolve
from dgae_jax.configs.parts import CRITICS, DESCENT, RESIDUALS, TARGETS, UPDATES, Part
from dgae_jax.configs.presets import PRESETS
from dgae_jax.configs.validation import validate
from dgae_jax.envs.registry import TASKS
from dgae_jax.learn.updates import descend, surrogate
from tests.probes import Target


def test_every_row_names_parts_that_exist():
    for row in TABLE.values():
        assert row.critic in CRITICS
        assert row.residual in RESIDUALS
        assert row.target in TARGETS
        assert row.policy_update in UPDATES


def test_a_distributional_variant_differs_from_its_baseline_in_critic_residual_and_target_only():
    for name in ("ppo", "trpo", "a2c"):
        baseline, variant = TABLE[name], TABLE["d" + name]
        assert variant == Row("quantile", "distributional", "sr-lambda", baseline.policy_update)
        assert baseline == Row("scalar", "td", "lambda-return", baseline.policy_update)


def test_parts_named_in_the_configuration_take_the_place_of_the_rows():
    config = dg.preset("tuned", "ppo", "hopper", update="trust-region")
    config = resolve(dg.Config(algo="ppo", residual="distributional", policy=config.policy, critic=dg.CriticConfig(kind="quantile")))
    assert (config.residual, config.critic.kind, config.critic.target) == ("distributional", "quantile", "lambda-return")


@pytest.mark.parametrize(("name", "algo", "env"), list(itertools.product(PRESETS, TABLE, TASKS)))
def test_presets_are_valid(name, algo, env):
    config = dg.preset(name, algo, env)
    validate(config)
    assert (config.algo, config.env) == (algo, env)


@pytest.mark.parametrize("env", TASKS)
@pytest.mark.parametrize("algo", TABLE)
def test_the_paper_preset_has_the_papers_networks_budgets_and_rollouts(algo, env):
    config, ant = dg.preset("paper", algo, env), env == "ant"
    assert config.policy.hidden == config.critic.hidden == ((512, 512) if ant else (256, 256))
    assert config.total_steps == (10_000_000 if env in ("ant", "hopper") else 5_000_000)
    assert config.critic.quantiles == (64 if TABLE[algo].critic == "quantile" else None)
    rollouts = {"clip": (4096, 2048), "trust-region": (50_000, 25_000), "gradient": (80, 80)}
    assert config.samples_per_iteration == rollouts[TABLE[algo].policy_update][0 if ant else 1]


@pytest.mark.parametrize("update", UPDATES)
def test_any_update_may_be_asked_of_any_algorithm(update):
    for algo in TABLE:
        config = dg.preset("tuned", algo, "hopper", update=update)
        validate(dg.Config(**{**vars(config), "policy": dg.PolicyConfig(**{**vars(config.policy), "update": update})}))


def test_a_seventh_row_joins_the_table_and_trains(monkeypatch):
    def cautious(policy, iterations, **fit):
        def loss(params, batch):
            value, info = surrogate(policy)(params, batch)
            return value + info["kl"], info

        return descend(loss, iterations, **fit)

    monkeypatch.setitem(UPDATES, "kl-penalty", Part(cautious, DESCENT))
    monkeypatch.setitem(TABLE, "mine", Row("quantile", "distributional", "lambda-shift", "kl-penalty"))
    fit = {"hidden": (8,), "epochs": 1, "minibatches": 1}
    config = dg.Config(
        algo="mine", num_envs=4, horizon=4, total_steps=64, policy=dg.PolicyConfig(**fit), critic=dg.CriticConfig(**fit, quantiles=4)
    )
    validate(config)
    init, train_step = dg.make_train(dg.make_algorithm("mine", Target(), config), Target(), config)
    before = jax.jit(init)(jax.random.key(0))
    after, metrics = jax.jit(train_step)(before)
    assert jnp.isfinite(metrics["policy/loss"])
    moved = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), before.policy.params, after.policy.params)
    assert max(jax.tree.leaves(moved)) > 0
