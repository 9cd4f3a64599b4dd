"""Estimates of memory."""

import dataclasses

import jax
import pytest

import dgae_jax as dg
from dgae_jax.learn.build import make_task
from dgae_jax.learn.memory import check_memory, needed
from tests.helpers import small


def test_memory_counts_at_least_the_state_and_the_rollout():
    # the state before and after; observation and successor of every sample, twice, in float32
    config = dg.resolve(small("ppo"))
    env = make_task(config)
    init, _ = dg.make_train(dg.make_algorithm("ppo", env, config), env, config)
    policy = jax.eval_shape(init, jax.random.key(0)).policy
    state = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(policy))
    assert needed(config, env) > 2 * state + 4 * 64 * 4 * 11
    assert needed(dataclasses.replace(config, num_seeds=7), env) == 7 * needed(config, env)


@pytest.mark.parametrize(
    ("change", "setting"),
    [
        ({"num_envs": 4_000_000}, "num_envs 4000000"),
        ({"num_steps": 4_000_000}, "num_steps 4000000"),
        ({"num_seeds": 4000, "num_steps": 1000}, "num_seeds 4000"),
        ({"policy.hidden": (60_000, 60_000)}, "policy.hidden 60000 60000"),
    ],
)
def test_a_run_that_does_not_fit_is_refused_by_its_largest_setting(change, setting):
    config = dg.Config(env="hopper", physics="native", total_steps=2**31 - 1).replace(**change)
    config = dg.resolve(config)
    needs = r"the run needs at least [\d,.]+ GiB of memory, and there are 2.0 GiB"
    with pytest.raises(dg.ConfigError, match=rf"^{setting}: must be smaller: {needs}"):
        check_memory(config, make_task(config), 2 * 2**30)
