"""The examples compute what the package computes."""

import re
import runpy

import jax
import pytest
from numpy.testing import assert_allclose

import dgae_jax as dg
from tests.helpers import ROOT

DPPO = ROOT / "examples" / "dppo.py"
SMALL = {"num_envs": 4, "num_steps": 64, "total_steps": 2560, "episode_length": 50}
FIT = {"hidden": (8, 8), "epochs": 2, "minibatches": 4}


@pytest.fixture(scope="module")
def example():
    return runpy.run_path(str(DPPO))


def test_dppo_has_the_settings_of_the_preset(example):
    config = dg.resolve(dg.preset("tuned", "dppo", "hopper"))
    for name, value in vars(example["Config"]()).items():
        found = [
            part[name]
            for part in (vars(config), vars(config.policy), *all_options(config))
            if name in part
        ]
        assert set(found) == {value}, name


def all_options(config):
    return config.policy.options, config.critic.options, config.critic.fit


def test_dppo_computes_what_the_package_computes(example):
    env = dg.make_env("hopper", physics="native")
    config = dg.preset("tuned", "dppo", "hopper").replace(physics="native", **SMALL)
    both = {f"{part}.{name}": x for part in ("policy", "critic") for name, x in FIT.items()}
    config = config.replace(**both, **{"critic.quantiles": 16})
    init, step = dg.make_train(dg.make_algorithm("dppo", env, config), env, config)
    ours, step = jax.jit(init)(jax.random.key(1)), jax.jit(step)

    options = example["Config"](physics="native", quantiles=16, **SMALL, **FIT)
    init, example_step = example["make_train"](options)
    theirs = init(jax.random.key(1))
    for _ in range(3):
        ours, metrics = step(ours)
        theirs, episode_return = example_step(theirs)
    assert_allclose(episode_return, metrics["episode_return"], rtol=1e-4)
    ours = ours.policy.params, ours.critic.params, ours.obs_stats.std
    theirs = theirs.policy.params, theirs.critic.params, theirs.obs_stats.std
    jax.tree.map(lambda a, b: assert_allclose(a, b, rtol=1e-4, atol=1e-6), ours, theirs)


def test_dppo_needs_nothing_of_the_trainer():
    rooms = set(re.findall(r"^(?:from|import) dgae_jax\.(\w+)", DPPO.read_text(), re.MULTILINE))
    assert rooms == {"maths"}
