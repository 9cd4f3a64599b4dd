"""The library refuses what the command line refuses, in words of the library."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.learn.build import make_task
from dgae_jax.learn.memory import check_memory, needed
from tests.helpers import SMALL, small
from tests.probes import Target

WRONG = [
    ({"gamma": 1.5}, "gamma 1.5: must be a number from 0 to 1"),
    ({"gamma": "0.9"}, "gamma: must be float, not '0.9'"),
    ({"algo": "ppo", "metric": "cvar:0.25"}, "metric cvar:0.25: must be mean with ppo"),
    ({"critic": dg.CriticConfig(target="foo")}, "critic.target foo: must be one of bellman"),
    (
        {"critic": dg.CriticConfig(quantiles=2**31 - 1)},
        r"critic.quantiles 2147483647: must be a whole number from 1 to 10,000 \(",
    ),
    (
        {"policy": dg.PolicyConfig(update="trust-region", max_backtracks=10**12)},
        r"policy.max_backtracks 1000000000000: .* 0 to 100 \(",
    ),
    (
        {"policy": dg.PolicyConfig(hidden=(10**18,))},
        "policy.hidden 1000000000000000000: must be widths of at most 65,536",
    ),
    ({"num_seeds": 2 * 10**9}, r"num_seeds 2000000000: must be a whole number from 1 to 4,096 \("),
]


@pytest.mark.parametrize(("change", "message"), WRONG)
def test_algorithms_training_and_runs_refuse_an_invalid_configuration(change, message, tmp_path):
    config, env = dg.Config(**change), Target()
    with pytest.raises(ConfigError, match=f"^{message}"):
        dg.make_algorithm(config.algo or "dppo", env, config)
    with pytest.raises(ConfigError, match=f"^{message}"):
        dg.make_train(dg.make_algorithm("dppo", env, dg.Config()), env, config)
    with pytest.raises(ConfigError, match=f"^{message}"):
        dg.train(config, tmp_path / "run", quiet=True)
    assert list(tmp_path.iterdir()) == []


def test_an_algorithm_other_than_the_configurations_is_refused_and_an_unset_one_is_filled_in():
    with pytest.raises(
        ConfigError, match=r"^algo dppo: must be ppo, as in make_algorithm, or left out$"
    ):
        dg.make_algorithm("ppo", Target(), dg.Config(algo="dppo"))
    assert dg.make_algorithm("ppo", Target(), dg.Config()).critic.predict is not None
    with pytest.raises(ConfigError, match=r"^algo sac: must be one of ppo, dppo"):
        dg.make_algorithm("sac", Target(), dg.Config())


def test_whole_numbers_for_floats_and_lists_for_tuples_compile_no_other_program():
    config = dg.Config(gamma=1, policy=dg.PolicyConfig(hidden=[8], clip=1))
    assert (type(config.gamma), type(config.policy.clip_eps), config.policy.hidden) == (
        float,
        float,
        (8,),
    )
    traces = []
    program = jax.jit(lambda config: traces.append(config) or config.gamma)
    assert [float(program(dg.Config(gamma=gamma))) for gamma in (1, 0.5, 1.0)] == [1, 0.5, 1]
    assert len(traces) == 1


def test_traced_values_pass_unchecked_and_the_rest_is_checked():
    @jax.jit
    def learned(gamma):
        return (
            dg.make_algorithm("dppo", Target(), dataclasses.replace(SMALL, gamma=gamma)) and gamma
        )

    assert learned(jnp.float32(0.5)) == 0.5
    with pytest.raises(ConfigError, match="num_steps 0"):
        jax.jit(lambda gamma: resolve(dg.Config(gamma=gamma, num_steps=0)))(0.5)


def test_memory_counts_at_least_the_state_and_the_rollout():
    # the state before and after, and observation and successor of every sample in the rollout and in the batch, in float32
    config = resolve(small("ppo"))
    env = make_task(config)
    init, _ = dg.make_train(dg.make_algorithm("ppo", env, config), env, config)
    state = sum(
        x.size * x.dtype.itemsize
        for x in jax.tree.leaves(jax.eval_shape(init, jax.random.key(0)).policy)
    )
    assert needed(config, env) > 2 * state + 4 * 64 * 4 * 11
    assert needed(dataclasses.replace(config, num_seeds=7), env) == 7 * needed(config, env)


def test_a_cpu_lays_out_no_residuals():
    few, many = (
        resolve(
            dataclasses.replace(small("dppo"), critic=dg.CriticConfig(quantiles=k, minibatches=1))
        )
        for k in (1000, 2000)
    )
    env = make_task(few)
    assert needed(many, env) < 3 * needed(
        few, env
    )  # not four times: a minibatch has K residuals at a time, and not K × K


@pytest.mark.parametrize(
    ("change", "setting"),
    [
        ({"num_envs": 4_000_000}, "num_envs 4000000"),
        ({"num_steps": 4_000_000}, "num_steps 4000000"),
        ({"num_seeds": 4000, "num_steps": 1000}, "num_seeds 4000"),
        ({"policy": dg.PolicyConfig(hidden=(60_000, 60_000))}, "policy.hidden 60000 60000"),
    ],
)
def test_a_run_that_does_not_fit_is_refused_with_both_numbers_and_the_setting_that_matters_most(
    change, setting
):
    config = dg.Config(env="hopper", physics="native", total_steps=2**31 - 1, **change)
    with pytest.raises(
        ConfigError,
        match=rf"^{setting}: must be smaller: the run needs at least [\d,.]+ GiB of memory, and there are 2.0 GiB",
    ):
        check_memory(resolve(config), make_task(config), 2 * 2**30)
