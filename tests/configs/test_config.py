import dataclasses

import jax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dgae_jax import Config, ConfigError, CriticConfig, PolicyConfig
from dgae_jax.configs.resolved import resolve
from dgae_jax.configs.serial import from_dict, to_dict


def changed(path, value):
    part, _, leaf = path.rpartition(".")
    if not part:
        return dataclasses.replace(Config(), **{path: value})
    return dataclasses.replace(
        Config(), **{part: dataclasses.replace(getattr(Config(), part), **{leaf: value})}
    )


def test_the_default_configuration_is_valid():
    resolve(Config())


@pytest.mark.parametrize(
    ("path", "value", "allowed"),
    [
        ("env", "hoper", "one of ant, hopper, swimmer, walker2d"),
        ("env_version", "v9", "one of v4, v5"),
        ("algo", "sac", "one of ppo, dppo"),
        ("physics", "bullet", "one of jax, mjx, mjx-warp, native"),
        ("seed", -1, "from 0 to"),
        ("num_seeds", 0, "from 1 to 4,096"),
        ("total_steps", 2047, "at least one iteration of num_envs \\* num_steps = 2,048"),
        ("total_steps", 2**31, "to 2,147,483,647"),
        ("num_envs", -3, "a whole number from 1 to"),
        ("num_steps", 0, "a whole number from 1 to"),
        ("episode_length", 0, "a whole number from 1 to"),
        ("gamma", 1.01, "from 0 to 1"),
        ("gamma", float("nan"), "from 0 to 1"),
        ("lam", -0.1, "from 0 to 1"),
        ("policy.hidden", (), "widths of at least 1"),
        ("policy.hidden", (64, 0), "widths of at least 1"),
        ("policy.covariance", "full", "one of shared, state"),
        ("policy.initial_std", 0.0, "above 0"),
        ("policy.clip_eps", -0.2, "above 0"),
        ("policy.learning_rate", float("inf"), "above 0"),
        ("policy.learning_rate_end", 2.0, "from 0 to 1"),
        ("policy.epochs", 0, "a whole number from 1 to"),
        ("policy.minibatches", 7, "a divisor of num_envs \\* num_steps = 2,048"),
        ("policy.max_grad_norm", 0.0, "above 0"),
        ("critic.minibatches", 3, "a divisor of num_envs \\* num_steps = 2,048"),
        ("critic.target", "td", "one of bellman"),
        ("critic.quantiles", 0, "a whole number from 1 to"),
        ("critic.kappa", 0.0, "above 0"),
    ],
)
def test_a_bad_value_is_refused_by_flag_value_and_what_is_allowed(path, value, allowed):
    with pytest.raises(ConfigError, match=f"^{path} .*: must be .*{allowed}"):
        resolve(changed(path, value))


def test_a_setting_the_algorithm_does_not_use_is_refused():
    with pytest.raises(
        ConfigError, match=r"critic.quantiles 32: must be left out: ppo with scalar does not use it"
    ):
        resolve(dataclasses.replace(changed("critic.quantiles", 32), algo="ppo"))


def test_resolving_writes_out_the_algorithms_own_target_and_keeps_a_chosen_one():
    assert resolve(Config(algo="ppo")).critic.target == "lambda-return"
    assert resolve(Config(algo="dppo")).critic.target == "sr-lambda"
    assert resolve(changed("critic.target", "bellman")).critic.target == "bellman"


@given(
    st.builds(
        Config,
        num_envs=st.integers(1, 100),
        total_steps=st.integers(1, 10**9),
        gamma=st.floats(0, 1),
        policy=st.builds(
            PolicyConfig,
            hidden=st.lists(st.integers(1, 99), min_size=1).map(tuple),
            clip=st.floats(0.01, 1),
        ),
        critic=st.builds(CriticConfig, quantiles=st.integers(1, 99)),
    )
)
def test_a_configuration_survives_json(config):
    import json

    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("gamma"), "gamma: missing"),
        (
            lambda d: d.pop("schema"),
            "schema: missing; before schema 2 the engine now called jax had the name mjx",
        ),
        (lambda d: d.update(schema=3), "schema 3: must be 2"),
        (lambda d: d.update(extra=1), "extra: unknown"),
        (lambda d: d.update(num_envs="16"), "num_envs: must be int"),
        (lambda d: d.update(num_envs=True), "num_envs: must be int"),
        (lambda d: d.update(policy=3), "policy: must be an object"),
        (lambda d: d["critic"].update(hidden="64"), "critic.hidden: must be tuple"),
        (lambda d: d["critic"].update(kapa=1), "critic.kapa: unknown"),
    ],
)
def test_json_that_is_no_configuration_is_refused_by_name(change, message):
    data = to_dict(Config())
    change(data)
    with pytest.raises(ConfigError, match=message):
        from_dict(data)


def test_leaves_of_the_configuration_are_its_floats_and_its_budget():
    leaves = {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in jax.tree.leaves_with_path(Config())
    }
    assert {name for name, leaf in leaves.items() if not isinstance(leaf, float)} == {"total_steps"}
    floats = [
        f"{part}.{f.name}"
        for part in ("policy", "critic")
        for f in dataclasses.fields(getattr(Config(), part))
        if f.type == "float" or f.type is float
    ]
    assert set(leaves) == {"gamma", "lam", "total_steps", *floats}
