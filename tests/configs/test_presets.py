"""The rows of algorithms and the presets of their settings."""

import pytest

import dgae_jax as dg
from dgae_jax.configs.algorithms import ALGORITHMS, Row
from dgae_jax.configs.parts import UPDATES
from dgae_jax.configs.presets import PRESETS
from dgae_jax.envs.registry import TASKS


@pytest.mark.parametrize("name", ["ppo", "trpo", "a2c"])
def test_variant_differs_from_baseline_in_critic_residual_and_target(name):
    baseline, variant = ALGORITHMS[name], ALGORITHMS["d" + name]
    assert variant == Row("quantile", "distributional", "sr-lambda", baseline.policy_update)
    assert baseline == Row("scalar", "td", "lambda-return", baseline.policy_update)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_presets_are_valid(name, algo):
    for env in TASKS:
        config = dg.resolve(dg.preset(name, algo, env))
        assert (config.algo, config.env) == (algo, env)


@pytest.mark.parametrize("env", TASKS)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_paper_preset_has_the_papers_networks_budgets_and_rollouts(algo, env):
    config, ant = dg.preset("paper", algo, env), env == "ant"
    assert config.policy.hidden == config.critic.hidden == ((512, 512) if ant else (256, 256))
    assert config.total_steps == (10_000_000 if env in ("ant", "hopper") else 5_000_000)
    assert config.critic.quantiles == (64 if ALGORITHMS[algo].critic == "quantile" else None)
    rollouts = {"clip": (4096, 2048), "trust-region": (50_000, 25_000), "gradient": (80, 80)}
    assert config.samples_per_iteration == rollouts[ALGORITHMS[algo].policy_update][0 if ant else 1]


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_any_update_may_be_asked_of_any_algorithm(algo, update):
    assert dg.resolve(dg.preset("tuned", algo, "hopper", update=update)).policy.update == update


def test_unknown_names_are_refused():
    for names in (("best", "ppo", "hopper"), ("tuned", "sac", "hopper")):
        with pytest.raises(dg.ConfigError, match="must be one of"):
            dg.preset(*names)
