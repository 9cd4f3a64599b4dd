"""The search space of a tuning."""

import dataclasses

import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.study.search import Tuning, shown, space_of, values_of, with_values

PPO = resolve(Config(algo="ppo", physics="native"))


@pytest.mark.parametrize(
    ("word", "distribution", "again"),
    [
        ("gamma=0.9:0.999", FloatDistribution(0.9, 0.999), "0.9:0.999"),
        (
            "policy.learning-rate=log:1e-4:1e-2",
            FloatDistribution(1e-4, 1e-2, log=True),
            "log:0.0001:0.01",
        ),
        ("num_envs=int:4:64", IntDistribution(4, 64), "int:4:64"),
        ("policy.epochs=int:log:1:20", IntDistribution(1, 20, log=True), "int:log:1:20"),
        ("critic.minibatches=16,32,64", CategoricalDistribution((16, 32, 64)), "16,32,64"),
        ("normalize_rewards=true,false", CategoricalDistribution((True, False)), "True,False"),
        ("policy.hidden=64x64,256", CategoricalDistribution(("64x64", 256)), "64x64,256"),
    ],
)
def test_a_word_becomes_an_optuna_distribution(word, distribution, again):
    ((path, found),) = space_of([word], PPO).items()
    assert path == word.partition("=")[0].replace("-", "_")
    assert found == distribution
    assert shown(found) == again


@pytest.mark.parametrize(
    ("word", "reason"),
    [
        ("gamma", "must be SETTING=LOW:HIGH, log:"),
        ("gae_lambda=0.9:1", "must be the only range of gae_lambda"),
        ("gama=0.9:1", r"valid throughout \(gama: unknown setting"),
        ("seed=int:0:9", "all trials share seed"),
        ("gamma=0.9:1.5", r"valid throughout \(gamma 1.5: must be a number from 0 to 1\)"),
        ("gamma=log:0:1", "must be SETTING="),
        ("gamma=0.9:nan", "must be SETTING="),
        ("num_envs=4:64", "num_envs: must be int, not 4.0"),
        ("num_envs=int:4.5:64", "must be SETTING="),
        ("gamma=0.9", "must be SETTING="),
        ("critic.minibatches=int:16:32", "critic.minibatches 17: must be a divisor"),
        ("policy.max_kl=0.01:0.1", "it has no effect with ppo"),
        ("policy.optimizer=adam,sgd", "policy.optimizer sgd: must be one of adam, rmsprop"),
    ],
)
def test_an_invalid_search_is_refused_by_its_word(word, reason):
    with pytest.raises(ConfigError, match=reason) as refused:
        space_of(["gae_lambda=0.5:1", word], PPO)
    assert str(refused.value).startswith(f"search {word}: must be ")
    assert refused.value.setting == "search"


def test_values_are_put_into_a_configuration_and_read_from_it():
    values = {"gamma": 0.5, "policy.hidden": "32x16"}
    changed = with_values(PPO, {**values, "critic.minibatches": 16})
    assert (changed.gamma, changed.policy.hidden) == (0.5, (32, 16))
    assert changed.critic.fit["minibatches"] == 16
    assert values_of(changed, dict.fromkeys(values)) == values
    assert with_values(changed, values_of(PPO, dict.fromkeys(values))).policy == PPO.policy


def test_trials_have_seeds_that_reports_do_not_use(tmp_path):
    tuning = Tuning(PPO, space_of(["gamma=0.9:0.999"], PPO), tmp_path, seeds=3)
    config = tuning.trial_config({"gamma": 0.95})
    assert (config.seed, config.num_seeds, config.gamma) == (1000, 3, 0.95)
    best = tuning.best_config({"gamma": 0.95})
    assert best == dataclasses.replace(config, seed=0, num_seeds=1)


def test_a_start_outside_of_the_space_is_no_trial(tmp_path):
    inside, outside = (
        Tuning(PPO, space_of([word], PPO), tmp_path)
        for word in ("gamma=0.9:0.999", "gamma=0.995:0.999")
    )
    assert inside.start_values() == {"gamma": 0.99}
    assert outside.start_values() is None
