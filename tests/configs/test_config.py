"""Configurations: what is accepted, what resolving fills in, and what is refused."""

from typing import get_args, get_type_hints

import pytest

from dgae_jax import Config, ConfigError, CriticConfig, PolicyConfig, ResolvedConfig, resolve
from dgae_jax.configs import parts
from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import NoiseConfig
from dgae_jax.configs.resolved import ResolvedCritic, ResolvedPolicy


def test_get_and_replace_take_dotted_paths():
    config = Config().replace(**{"policy.clip_eps": 0.3, "noise.reward": 1, "num_envs": 4})
    assert config.get("policy.clip_eps") == config.policy.clip_eps == 0.3
    assert (config.noise.reward, config.num_envs) == (1.0, 4)
    assert config.replace(**{"policy.clip_eps": None, "noise.reward": 0, "num_envs": 16}) == (
        Config()
    )


@pytest.mark.parametrize("path", ["gama", "policy.clip", "critic.hidden.width"])
def test_replace_refuses_a_setting_that_does_not_exist(path):
    with pytest.raises(ConfigError, match=f"^{path}: unknown setting"):
        Config().replace(**{path: 1})


@pytest.mark.parametrize("env", ["Hopper-v5", "hopper-v5", "hopper"])
@pytest.mark.parametrize("algo", ["DPPO", "dppo"])
def test_names_are_understood_as_other_trainers_write_them(env, algo):
    config = Config(env=env, algo=algo, env_version="v5")
    assert (config.env, config.env_version, config.algo) == ("hopper", "v5", "dppo")


def test_a_version_in_the_name_must_agree_with_the_setting():
    with pytest.raises(ConfigError, match=r"^env_version v4: must be v5, as in Hopper-v5"):
        Config(env="Hopper-v5", env_version="v4")


def test_whole_numbers_become_floats_and_lists_tuples():
    config = Config(gamma=1, policy=PolicyConfig(hidden=[8], clip_eps=1))
    assert type(config.gamma) is type(config.policy.clip_eps) is float
    assert config.policy.hidden == (8,)


@pytest.mark.parametrize("cls", [ResolvedConfig, ResolvedPolicy, ResolvedCritic, NoiseConfig])
def test_nothing_but_the_version_is_optional_once_resolved(cls):
    optional = {name for name, kind in get_type_hints(cls).items() if type(None) in get_args(kind)}
    assert optional == ({"env_version"} if cls is ResolvedConfig else set())


@pytest.mark.parametrize(
    ("cls", "setting", "table"),
    [
        (Config, "algo", ALGORITHMS),
        (Config, "residual", parts.RESIDUALS),
        (PolicyConfig, "update", parts.UPDATES),
        (PolicyConfig, "covariance", parts.COVARIANCES),
        (PolicyConfig, "optimizer", parts.OPTIMIZERS),
        (CriticConfig, "optimizer", parts.OPTIMIZERS),
        (CriticConfig, "kind", parts.CRITICS),
        (CriticConfig, "target", parts.TARGETS),
    ],
)
def test_literal_types_name_the_entries_of_their_tables(cls, setting, table):
    kind = get_type_hints(cls)[setting]
    names = get_args(kind)
    if type(None) in names:
        names = get_args(names[0])
    assert set(names) == set(table)


def test_resolving_fills_in_the_algorithms_parts_and_keeps_chosen_ones():
    assert resolve(Config(algo="ppo")).critic.target == "lambda-return"
    config = resolve(Config(residual="td", critic=CriticConfig(target="bellman", quantiles=8)))
    assert (config.algo, config.residual, config.physics) == ("dppo", "td", "jax")
    assert (config.critic.kind, config.critic.target) == ("quantile", "bellman")
    assert dict(config.critic.options) == {"quantiles": 8, "kappa": 1.0}
    assert config.policy.options["clip_eps"] == 0.2
    assert (config.critic.outputs, config.critic.is_distribution) == (8, True)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_resolving_twice_or_by_way_of_a_config_changes_nothing(algo):
    config = resolve(Config(algo=algo))
    assert resolve(config) is config
    assert resolve(config.as_config()) == config
    assert hash(config) == hash(resolve(config.as_config()))


@pytest.mark.parametrize(
    ("path", "value", "allowed"),
    [
        ("env", "hoper", "one of ant, hopper, swimmer, walker2d"),
        ("env_version", "v9", "one of v4, v5"),
        ("algo", "sac", "one of ppo, dppo"),
        ("physics", "bullet", "one of jax, mjx, mjx-warp, native"),
        ("seed", -1, "from 0 to"),
        ("num_seeds", 0, "from 1 to 4,096"),
        ("total_steps", 2047, r"at least one iteration of num_envs \* num_steps = 2,048"),
        ("total_steps", 2**31, "to 2,147,483,647"),
        ("num_envs", -3, "a whole number from 1 to"),
        ("num_steps", 0, "a whole number from 1 to"),
        ("episode_length", 0, "a whole number from 1 to"),
        ("gamma", 1.01, "from 0 to 1"),
        ("gamma", float("nan"), "from 0 to 1"),
        ("gae_lambda", -0.1, "from 0 to 1"),
        ("metric", "median", "one of mean, cvar:"),
        ("noise.action", -1.0, "a finite number of at least 0"),
        ("policy.hidden", (), "widths from 1 to 65,536"),
        ("policy.hidden", (64, 0), "widths from 1 to 65,536"),
        ("policy.hidden", (10**18,), "widths from 1 to 65,536"),
        ("policy.covariance", "full", "one of shared, state"),
        ("policy.optimizer", "lion", "one of adam, rmsprop"),
        ("policy.initial_std", 0.0, "above 0"),
        ("policy.clip_eps", -0.2, "above 0"),
        ("policy.learning_rate", float("inf"), "above 0"),
        ("policy.learning_rate_end", 2.0, "from 0 to 1"),
        ("policy.epochs", 0, "a whole number from 1 to"),
        ("policy.minibatches", 7, r"a divisor of num_envs \* num_steps = 2,048"),
        ("policy.max_grad_norm", 0.0, "above 0"),
        ("critic.kind", "swish", "one of scalar, quantile"),
        ("critic.minibatches", 3, r"a divisor of num_envs \* num_steps = 2,048"),
        ("critic.target", "td", "one of bellman"),
        ("critic.quantiles", 0, "a whole number from 1 to"),
        ("critic.quantiles", 2**31 - 1, "a whole number from 1 to 10,000"),
        ("critic.kappa", 0.0, "above 0"),
    ],
)
def test_an_invalid_value_is_refused_with_what_is_allowed(path, value, allowed):
    with pytest.raises(ConfigError, match=f"^{path} .*: must be .*{allowed}") as error:
        resolve(Config().replace(**{path: value}))
    assert error.value.setting == path


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            Config(algo="ppo", critic=CriticConfig(quantiles=32)),
            r"critic.quantiles 32: must be unset: it has no effect with ppo \(critic.kind scalar\)",
        ),
        (
            Config(algo="trpo", policy=PolicyConfig(clip_eps=0.1)),
            "policy.clip_eps 0.1: must be unset: it has no effect with trpo",
        ),
        (Config(algo="ppo", metric="cvar:0.25"), "metric cvar:0.25: must be mean with ppo"),
        (
            Config(algo="ppo", diagnostics=True),
            "diagnostics True: must be off: the critic is scalar",
        ),
        (Config(gamma="0.9"), "gamma: must be float, not '0.9'"),
        (Config(policy={"clip_eps": 0.1}), "policy .*: must be PolicyConfig"),
        (Config(policy=PolicyConfig(hidden=(8,) * 40)), "policy.hidden of 40 layers: must be"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(config, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        resolve(config)
