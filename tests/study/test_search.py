"""What a tuning searches, as it is written on the command line."""

import dataclasses

import pytest

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import Config, ConfigError, CriticConfig, PolicyConfig
from dgae_jax.configs.presets import preset
from dgae_jax.configs.resolved import resolve
from dgae_jax.study.search import USUAL, Choice, Range, is_traced, space_of, values_of, with_values

PPO, TRPO = (resolve(Config(algo=algo, physics="native")) for algo in ("ppo", "trpo"))


def test_a_range_is_what_its_words_say():
    space = space_of(
        [
            "gamma=0.9:0.999",
            "policy.learning-rate=log:1e-4:1e-2",
            "num_envs=int:4:64",
            "policy.epochs=int:log:1:20",
        ],
        PPO,
    )
    assert space == {
        "gamma": Range(0.9, 0.999),
        "policy.learning_rate": Range(1e-4, 1e-2, log=True),
        "num_envs": Range(4, 64, whole=True),
        "policy.epochs": Range(1, 20, log=True, whole=True),
    }
    assert {path: str(each) for path, each in space.items()} == {
        "gamma": "0.9:0.999", "policy.learning_rate": "log:0.0001:0.01", "num_envs": "int:4:64", "policy.epochs": "int:log:1:20",
    }  # fmt: skip


def test_a_list_is_a_choice_of_values_of_the_settings_type():
    words = [
        "critic.minibatches=16,32,64",
        "normalize_rewards=true,false",
        "policy.hidden=64x64,256x256",
        "lam=0.9,1",
    ]
    assert space_of(words, PPO) == {
        "critic.minibatches": Choice((16, 32, 64)),
        "normalize_rewards": Choice((True, False)),
        "policy.hidden": Choice(("64x64", "256x256")),
        "lam": Choice((0.9, 1.0)),
    }


def test_a_range_holds_both_of_its_ends_and_nothing_outside():
    span = Range(4, 64, whole=True)
    assert (4 in span, 64 in span, 3 in span, 65 in span, None in span) == (
        True,
        True,
        False,
        False,
        False,
    )


def test_values_take_their_place_in_the_configuration_and_are_read_from_it():
    values = {"gamma": 0.5, "policy.hidden": "32x16", "critic.minibatches": 16}
    changed = with_values(PPO, values)
    assert (changed.gamma, changed.policy.hidden, changed.critic.minibatches) == (0.5, (32, 16), 16)
    assert (
        dataclasses.replace(changed, gamma=PPO.gamma, policy=PPO.policy, critic=PPO.critic) == PPO
    )
    assert values_of(changed, dict.fromkeys(values, Choice(()))) == values


def test_the_usual_search_holds_the_values_that_every_preset_starts_from():
    space = space_of(USUAL, PPO)
    for config in (
        preset("tuned", algo, env)
        for algo in ALGORITHMS
        for env in ("ant", "hopper", "swimmer", "walker2d")
    ):
        assert all(value in space[path] for path, value in values_of(config, space).items())


def test_what_one_program_serves_are_the_numbers_that_are_leaves_of_the_configuration():
    import dgae_jax.configs.pytree  # noqa: F401  (registers the parts)
    import jax

    leaves = jax.tree_util.tree_flatten_with_path(
        Config(policy=PolicyConfig(clip=0.2), critic=CriticConfig(kappa=1.0))
    )[0]
    named = {jax.tree_util.keystr(at, simple=True, separator=".") for at, _ in leaves} - {
        "total_steps"
    }
    assert named >= {"gamma", "lam", "policy.clip_eps", "critic.kappa"}
    assert all(is_traced(path) for path in named)
    assert not any(
        is_traced(path)
        for path in (
            "num_envs",
            "critic.minibatches",
            "metric",
            "noise.reward",
            "normalize_rewards",
        )
    )


@pytest.mark.parametrize(
    ("word", "config", "reason"),
    [
        ("gamma", PPO, "must be SETTING=LOW:HIGH, =log:"),
        ("gama=0.9:1", PPO, "must be of one of residual, metric, "),
        ("seed=int:0:9", PPO, "must be of another setting: all trials have the same seed"),
        ("gamma=0.9:1.5", PPO, r"must be valid throughout \(gamma 1.5: must be a number from 0 to 1\)"),
        ("gamma=-1:1", PPO, r"must be valid throughout \(gamma -1.0: must be a number from 0 to 1\)"),
        ("gamma=0.9:0.9", PPO, "must be LOW:HIGH with LOW below HIGH"),
        ("gamma=1:0.9", PPO, "must be LOW:HIGH with LOW below HIGH"),
        ("gamma=log:0:1", PPO, "must be above 0, for the sake of its logarithm"),
        ("gamma=low:high", PPO, "must be between numbers, LOW:HIGH"),
        ("gamma=0.9:nan", PPO, "must be between numbers, LOW:HIGH"),
        ("gamma=exp:0.9:1", PPO, "must be LOW:HIGH, log:LOW:HIGH, int:LOW:HIGH or int:log:LOW:HIGH of a setting that is a number"),
        ("gamma=int:0:1", PPO, "must be without int:, its values are not whole"),
        ("num_envs=4:64", PPO, "must be int:LOW:HIGH, its values are whole"),
        ("num_envs=int:4.5:64", PPO, "must be between whole numbers, LOW:HIGH"),
        ("metric=a:b", PPO, "of a setting that is a number"),
        ("gamma=0.9", PPO, "must be a list of two or more different values"),
        ("gamma=0.9,0.9", PPO, "must be a list of two or more different values"),
        ("critic.minibatches=16,x", PPO, "must be a list of whole numbers, with commas between them"),
        ("critic.minibatches=16,48", PPO, r"must be valid throughout \(critic.minibatches 48: must be a divisor of num_envs \* num_steps"),
        ("critic.minibatches=int:16:32", PPO, r"must be valid throughout \(critic.minibatches 17: must be a divisor"),
        ("policy.max_kl=0.01:0.1", PPO, r"valid throughout \(policy.max_kl 0.01: must be left out: ppo with clip does not use it\)"),
        ("policy.clip_eps=0.1:0.3", TRPO, r"\(policy.clip_eps 0.1: must be left out: trpo with trust-region does not use it\)"),
        ("critic.quantiles=16,32", TRPO, r"\(critic.quantiles 16: must be left out: trpo with scalar does not use it\)"),
        ("policy.optimizer=adam,sgd", PPO, r"\(policy.optimizer sgd: must be one of adam, rmsprop\)"),
    ],
)  # fmt: skip
def test_what_cannot_be_searched_is_refused_with_the_word_itself(word, config, reason):
    with pytest.raises(ConfigError, match=reason) as refused:
        space_of([word], config)
    assert str(refused.value).startswith(f"search {word}: must be ")
    assert refused.value.setting == "search"


def test_a_setting_is_searched_once():
    with pytest.raises(
        ConfigError, match=r"search gamma=0\.8:0\.9: must be the only range of gamma"
    ):
        space_of(["gamma=0.9:1", "gamma=0.8:0.9"], PPO)
