"""The table of tasks, and Brax on either side of it."""

import pytest
from numpy.testing import assert_array_equal

import dgae_jax as dg
from dgae_jax.envs import registry
from dgae_jax.envs.registry import TASKS, custom_env, spec_of
from dgae_jax.physics.registry import ENGINES
from tests.probes import Counter


def test_our_tasks_run_on_every_engine():
    for name, spec in TASKS.items():
        assert spec.engines == tuple(ENGINES)
        assert spec.default_version == "v4"
        assert spec.eval_env("v5").lower() == f"{name}-v5"


def test_brax_tasks_run_on_mjx_and_evaluate_themselves():
    spec = spec_of("brax:ant")
    assert spec.engines == ("mjx",)
    assert spec.eval_envs == {}
    assert spec.eval_env() is None
    assert_array_equal(dg.make_env("brax:fast").action_range, [[-1], [1]])


def test_name_may_hold_the_version(key):
    named, separate = dg.make_env("Hopper-v5"), dg.make_env("hopper", version="v5")
    assert type(named) is type(separate)
    assert named.version == separate.version == "v5"
    assert_array_equal(named.reset(key).obs, separate.reset(key).obs)
    with pytest.raises(ValueError, match="version v4: must be v5 as in the name, or left out"):
        dg.make_env("Hopper-v5", version="v4")


PREFIXES = "one of ant, hopper, swimmer, walker2d, or brax:NAME, playground:NAME or gymnasium:ID"


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        *((name, PREFIXES) for name in ("hoper", "brax:", "gymnasium:", "")),
        ("custom:Mine", "given as an object from Python"),
    ],
)
def test_unknown_task_is_refused_with_what_exists(name, allowed):
    with pytest.raises(ValueError, match=f"^{allowed}"):
        spec_of(name)
    with pytest.raises(ValueError, match=f"^environment {name}: must be {allowed}"):
        dg.make_env(name)


def test_missing_package_is_refused_with_how_to_install_it(monkeypatch):
    monkeypatch.setattr(registry, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r'not installed: pip install "dgae_jax\[playground\]"$'):
        spec_of("playground:CartpoleBalance")


def test_custom_env_is_registered_while_the_context_lasts():
    inner, outer = Counter(), Counter()
    with custom_env(outer) as name, custom_env(inner):
        assert name == "custom:Counter"
        assert dg.make_env(name).env is inner
        with custom_env(None) as nothing:
            assert nothing is None
    assert registry.CUSTOM_ENVS == {}


@pytest.mark.parametrize(
    ("name", "options", "allowed"),
    [
        ("hopper", {"physics": "bullet"}, "physics bullet: must be one of jax, mjx, mjx-warp, nat"),
        ("hopper", {"version": "v9"}, "version v9: must be one of v4, v5"),
        ("brax:ant", {"physics": "native"}, "physics native: must be one of mjx"),
        ("brax:ant", {"version": "v4"}, "version v4: must be left out"),
        ("brax:antt", {}, "Brax cannot build antt on mjx"),
        ("brax:swimmer", {}, "Brax cannot build swimmer on mjx"),
        ("brax:ant", {"feet": 4}, "Brax cannot build ant on mjx: .*feet"),
    ],
)
def test_engine_or_version_a_task_lacks_is_refused(name, options, allowed):
    with pytest.raises(ValueError, match=f"^{allowed}"):
        dg.make_env(name, **options)


def test_building_a_brax_env_prints_nothing(monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    dg.make_env("brax:halfcheetah")
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []
