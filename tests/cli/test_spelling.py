import pytest

from dgae_jax.cli.spelling import ELSEWHERE, FLAGS, understood
from dgae_jax.cli.train import parsed
from dgae_jax.configs.config import ConfigError


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["--total-steps", "1e6"], ["--total-steps", "1000000"]),
        (["--total-steps=2.5E5"], ["--total-steps", "250000"]),
        (["--checkpoint_every", "1e5"], ["--checkpoint_every", "100000"]),
        (["--gamma", "1e-1"], ["--gamma", "1e-1"]),
        (["--total-steps", "1.5e0"], ["--total-steps", "1.5e0"]),
        (["--algo", "PPO"], ["--algo", "ppo"]),
        (["--env", "Hopper-v4"], ["--env", "hopper", "--env-version", "v4"]),
        (["--env", "Walker2d"], ["--env", "walker2d"]),
        (["--env", "brax:Ant"], ["--env", "brax:Ant"]),
    ],
)
def test_what_can_mean_one_thing_is_understood(words, meant):
    assert understood(words) == meant


def test_a_command_line_as_other_trainers_write_it_is_the_configuration_it_means():
    config, _ = parsed(
        ["--env", "Ant-v5", "--algo", "DTRPO", "--total-steps", "3e6", "--physics=native"]
    )
    assert (config.env, config.env_version, config.algo, config.total_steps, config.physics) == (
        "ant",
        "v5",
        "dtrpo",
        3_000_000,
        "native",
    )


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("--policy.lr", "--policy.learning-rate"),
        ("--learning-rate", "--policy.learning-rate or --critic.learning-rate"),
        ("--lr=3e-4", "--policy.learning-rate or --critic.learning-rate"),
        ("--clip", "--policy.clip_eps-eps"),
        ("--clip_range", "--policy.clip_eps-eps"),
        ("--gae-lambda", "--gae-lambda"),
        ("--n_steps", "--num-steps"),
        ("--total-timesteps", "--total-steps"),
        ("--critic.n-quantiles", "--critic.quantiles"),
    ],
)
def test_another_name_of_a_flag_is_refused_with_the_one_that_is_meant(word, meant):
    with pytest.raises(ConfigError, match=f"^{word.partition('=')[0]}: is written {meant}$"):
        understood([word, "1"])


def test_every_name_from_elsewhere_means_a_flag_that_exists_and_is_none_itself():
    for name, ours in ELSEWHERE.items():
        assert name not in FLAGS
        assert any(flag.rpartition(".")[2] == ours for flag in FLAGS), ours


def test_two_versions_of_a_task_are_refused():
    with pytest.raises(ConfigError, match="env-version: must be one, not v4 and v5"):
        parsed(["--env", "Hopper-v4", "--env-version", "v5"])
