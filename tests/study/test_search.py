"""The search space of a tuning."""

import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.study.search import Tuning, space_of

PPO = resolve(Config(algo="ppo", physics="native"))


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("gamma=0.9:0.999", FloatDistribution(0.9, 0.999)),
        ("policy.learning-rate=log:1e-4:1e-2", FloatDistribution(1e-4, 1e-2, log=True)),
        ("num_envs=int:4:64", IntDistribution(4, 64)),
        ("policy.epochs=int:log:1:20", IntDistribution(1, 20, log=True)),
        ("critic.minibatches=16,32,64", CategoricalDistribution((16, 32, 64))),
        ("normalize_rewards=true,false", CategoricalDistribution((True, False))),
        ("policy.hidden=64x64,256", CategoricalDistribution(("64x64", 256))),
    ],
)
def test_a_word_becomes_values_that_optuna_suggests(word, values):
    assert space_of([word], PPO) == {word.partition("=")[0].replace("-", "_"): values}


@pytest.mark.parametrize(
    ("word", "reason"),
    [
        ("gamma", "must be SETTING=LOW:HIGH, log:"),
        ("gae_lambda=0.9:1", "gae_lambda is given twice"),
        ("gama=0.9:1", "gama: unknown setting"),
        ("seed=int:0:9", "all trials share seed"),
        ("gamma=0.9:1.5", "gamma 1.5: must be a number from 0 to 1"),
        ("gamma=log:0:1", "must be SETTING="),
        ("gamma=0.9:nan", "must be SETTING="),
        ("num_envs=4:64", "num_envs: must be int, not 4.0"),
        ("num_envs=int:4.5:64", "must be SETTING="),
        ("policy.max_kl=0.01:0.1", "it has no effect with ppo"),
        ("policy.optimizer=adam,sgd", "policy.optimizer sgd: must be one of adam, rmsprop"),
    ],
)
def test_an_invalid_search_is_refused_by_its_word(word, reason):
    with pytest.raises(ConfigError, match=reason) as refused:
        space_of(["gae_lambda=0.5:1", word], PPO)
    assert str(refused.value).startswith(f"search {word}: ")


def test_trials_have_seeds_that_reports_do_not_use(tmp_path):
    config = Tuning(PPO, {}, tmp_path, seeds=3).trial_config(
        {"gamma": 0.95, "policy.hidden": "32x16", "critic.hidden": 8}
    )
    assert (config.seed, config.num_seeds, config.gamma) == (1000, 3, 0.95)
    assert (config.policy.hidden, config.critic.hidden) == ((32, 16), (8,))
