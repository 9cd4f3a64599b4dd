"""The runs of a sweep, on disk and in results."""

import json

import pytest

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.configs.serial import differences, from_dict
from dgae_jax.run import metrics
from dgae_jax.study import reproduce
from dgae_jax.study import sweep as sweeps
from dgae_jax.study.variants import VARIANTS
from tests.helpers import ROOT

COMMITTED = sorted(path.parent for path in (ROOT / "results").glob("*/study.json"))


def make(task, algo):
    return resolve(dg.Config(env=task, algo=algo, physics="native"))


def grid(seeds=(0, 1), per_run=1, make=make):
    return sweeps.grid(["hopper", "ant"], ["ppo", "dppo"], seeds, per_run, make)


def test_the_first_seeds_of_all_pairs_come_first():
    runs = ["hopper-ppo-0", "hopper-dppo-0", "ant-ppo-0", "ant-dppo-0", "hopper-ppo-1"]
    assert list(grid())[:5] == runs
    assert [sweeps.label_of(*run) for run in grid().items()][:4] == ["ppo", "dppo", "ppo", "dppo"]


def test_several_seeds_of_a_run_must_be_consecutive():
    configs = grid((0, 1, 2, 3), 2)
    runs = [configs[run] for run in ("hopper-ppo-0-1", "hopper-ppo-2-3")]
    assert [(config.seed, config.num_seeds) for config in runs] == [(0, 2), (2, 2)]
    with pytest.raises(ConfigError, match=r"seeds_per_run 2: must be 1, .* not \[0, 2\]"):
        grid((0, 2, 3, 4), 2)


def test_a_variant_names_the_run_instead_of_the_algorithm():
    (run,) = sweeps.grid(["brax:ant"], ["kappa-0.1"], (3, 4), 2, lambda *_: make("ant", "dppo"))
    assert run == "brax_ant-kappa-0.1-3-4"
    (run,) = sweeps.grid(["ant"], ["kappa-0.1"], (3, 4), 2, lambda *_: make("ant", "dppo")).items()
    assert sweeps.label_of(*run) == "kappa-0.1"


@pytest.mark.parametrize("question", VARIANTS)
def test_every_variant_is_a_configuration_of_its_own(question):
    configs = {
        name: resolve(make("hopper", algo).as_config().replace(**changes))
        for name, (algo, changes) in VARIANTS[question].items()
    }
    assert len({str(config) for config in configs.values()}) == len(configs)
    for name, config in configs.items():
        assert name.endswith("+noise") == (config.noise.reward > 0)


def test_a_sweep_keeps_its_runs_and_the_commands_that_asked_for_them(tmp_path):
    with sweeps.opened(tmp_path / "sweep", grid((0,)), "one"):
        pass
    with sweeps.opened(tmp_path / "sweep", grid((0, 1)), "two") as sweep:
        assert sweep == sweeps.read(tmp_path / "sweep")
    assert list(sweep.runs) == list(grid((0, 1)))
    assert (sweep.commands["ant-ppo-0"], sweep.commands["ant-ppo-1"]) == ("one", "two")


def test_another_configuration_of_a_run_is_refused(tmp_path):
    with sweeps.opened(tmp_path, grid(), "one"):
        pass
    before = (tmp_path / "study.json").read_bytes()
    other = grid(make=lambda *pair: resolve(make(*pair).as_config().replace(gamma=0.9)))
    message = r"^run hopper-ppo-0: its gamma must be 0\.99 as in .*, not 0\.9"
    with pytest.raises(ConfigError, match=message), sweeps.opened(tmp_path, other, ""):
        pass
    assert (tmp_path / "study.json").read_bytes() == before


def test_a_directory_in_use_or_of_something_else_is_refused(tmp_path):
    with sweeps.opened(tmp_path / "sweep", grid(), "one"):
        message = "must not be in use"
        with pytest.raises(ConfigError, match=message), sweeps.opened(tmp_path / "sweep", {}, ""):
            pass
    message = "must be a sweep, or a new or empty directory"
    with pytest.raises(ConfigError, match=message), sweeps.opened(tmp_path, grid(), ""):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["sweep"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data | {"schema": 2}, "its schema is 2, not 1"),
        (lambda data: data | {"cells": {"../x": data["cells"]["ant-ppo-0"]}}, "cannot be the name"),
        (lambda data: data | {"cells": [1]}, "must be a sweep that can be read"),
        (lambda data: {}, "must be a sweep that can be read"),
        (lambda data: None, "must be the directory of a sweep"),
    ],
)
def test_a_sweep_that_cannot_be_read_is_refused(tmp_path, change, message):
    with sweeps.opened(tmp_path, grid(), "one"):
        pass
    file = tmp_path / "study.json"
    changed = change(json.loads(file.read_text()))
    file.write_text(json.dumps(changed)) if changed is not None else file.unlink()
    with pytest.raises(ConfigError, match=message):
        sweeps.read(tmp_path)


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.name)
def test_a_committed_sweep_is_read_and_its_runs_are_done(path):
    sweep = sweeps.read(path)
    rows = reproduce.read_results(sweep)
    committed = metrics.read(path / "results.jsonl")
    assert rows.keys() == {row["cell"] for row in committed}
    for run, config in sweep.runs.items():
        expected = [row for row in committed if row["cell"] == run]
        assert rows.get(run, []) == expected
        assert all(differences(from_dict(row["config"]), config) == {} for row in expected)


def test_a_long_curve_is_averaged_to_two_hundred_points():
    rows = [
        {"steps": 10 * (i + 1), "episode_return": float(i) if i > 2 else None} for i in range(400)
    ]
    curve = reproduce._curve(rows)
    assert (curve["steps"][:3], curve["steps"][-1]) == ([20, 40, 60], 4000)
    assert curve["return"][:4] == [None, 3.0, 4.5, 6.5]
    assert len(curve["return"]) == 200
    assert reproduce._curve(rows[3:5]) == {"steps": [40, 50], "return": [3.0, 4.0]}
