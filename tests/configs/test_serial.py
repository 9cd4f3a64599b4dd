"""Configurations as JSON: written whole, read strictly, old schemas upgraded."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dgae_jax import Config, ConfigError, CriticConfig, PolicyConfig, resolve
from dgae_jax.configs.serial import RENAMED, SCHEMA, differences, from_dict, to_dict


@given(
    st.builds(
        Config,
        num_envs=st.integers(1, 100),
        total_steps=st.integers(1, 10**9),
        gamma=st.floats(0, 1),
        policy=st.builds(
            PolicyConfig,
            hidden=st.lists(st.integers(1, 99), min_size=1).map(tuple),
            clip_eps=st.floats(0.01, 1),
        ),
        critic=st.builds(CriticConfig, quantiles=st.integers(1, 99)),
    )
)
def test_a_configuration_survives_json(config):
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


@pytest.mark.parametrize("algo", ["ppo", "dtrpo", "da2c"])
def test_a_resolved_configuration_survives_json(algo):
    config = resolve(Config(algo=algo))
    assert resolve(from_dict(json.loads(json.dumps(to_dict(config))))) == config


def old(config):
    """Plain data of schema 2: the names before the first upgrade."""
    data = to_dict(config) | {"schema": 2}
    for before, now in RENAMED[2].items():
        group, _, name = now.rpartition(".")
        inner = data[group] if group else data
        inner[before.rpartition(".")[2]] = inner.pop(name)
    return data


@pytest.mark.parametrize(
    "config",
    [
        Config(num_steps=64, gae_lambda=0.8, policy=PolicyConfig(clip_eps=0.1)),
        Config(algo="trpo", policy=PolicyConfig(max_kl=0.02, max_backtracks=5)),
    ],
)
def test_schema_2_reads_as_the_same_configuration_in_new_names(config):
    data = old(config)
    assert {"horizon", "lam"} <= set(data)
    assert {"clip", "radius", "backtracks"} <= set(data["policy"])
    assert resolve(from_dict(data)) == resolve(config)


def test_differences_name_the_settings_and_both_values():
    one, two = Config(), Config(gamma=0.9, policy=PolicyConfig(clip_eps=0.1))
    assert differences(one, two) == {"gamma": (0.99, 0.9), "policy.clip_eps": (None, 0.1)}
    assert differences(one, one) == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("gamma"), "gamma: missing"),
        (lambda d: d.pop("schema"), "schema: missing"),
        (lambda d: d.update(schema=SCHEMA + 1), f"schema {SCHEMA + 1}: must be one of 2, {SCHEMA}"),
        (lambda d: d.update(horizon=1), "horizon: unknown"),
        (lambda d: d.update(num_envs="16"), "num_envs: must be int"),
        (lambda d: d.update(num_envs=True), "num_envs: must be int"),
        (lambda d: d.update(policy=3), "policy: unknown"),
        (lambda d: d["critic"].update(hidden="64"), "critic.hidden: must be tuple"),
        (lambda d: d["critic"].update(kapa=1), "critic.kapa: unknown"),
    ],
)
def test_json_that_is_no_configuration_is_refused_by_name(change, message):
    data = to_dict(Config())
    change(data)
    with pytest.raises(ConfigError, match=message):
        from_dict(data)
