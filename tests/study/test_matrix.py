"""Which cells a study has."""

import json

import pytest

import dgae_jax as dg
from dgae_jax.cli import reproduce
from dgae_jax.cli.arguments import parse_known
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.configs.serial import to_dict
from dgae_jax.study import matrix
from dgae_jax.study.variants import VARIANTS


def make(task, algo):
    return resolve(dg.Config(env=task, algo=algo, physics="native"))


def cells(seeds=(0, 1), per_run=1, make=make):
    return matrix.matrix(["hopper", "ant"], ["ppo", "dppo"], seeds, per_run, make)


def test_the_first_seeds_of_all_pairs_come_first():
    names = [cell.name for cell in cells()]
    assert names == [
        "hopper-ppo-0", "hopper-dppo-0", "ant-ppo-0", "ant-dppo-0", "hopper-ppo-1", "hopper-dppo-1", "ant-ppo-1", "ant-dppo-1",
    ]  # fmt: skip


def test_seeds_side_by_side_are_one_cell_named_by_its_first_and_last():
    found = cells((0, 1, 2, 3), 2)
    assert [cell.name for cell in found][::4] == ["hopper-ppo-0-1", "hopper-ppo-2-3"]
    assert [(cell.config.seed, cell.config.num_seeds) for cell in found][::4] == [(0, 2), (2, 2)]


def test_only_seeds_that_follow_each_other_run_side_by_side():
    with pytest.raises(
        ConfigError,
        match=r"seeds_per_run 2: must be 1, or a number of seeds that follow each other, not \[0, 2\]",
    ):
        cells((0, 2, 3, 4), 2)


def test_a_study_keeps_its_cells_and_the_command_that_asked_for_each_first(tmp_path):
    with matrix.opened(tmp_path / "study", cells((0,)), "one"):
        pass
    with matrix.opened(tmp_path / "study", cells((0, 1)), "two") as study:
        assert study == matrix.read(tmp_path / "study")
    assert [cell.name for cell in study.cells] == [cell.name for cell in cells((0, 1))]
    assert study.commands["ant-ppo-0"] == "one"
    assert study.commands["ant-ppo-1"] == "two"


def test_a_cell_with_another_configuration_is_refused_by_name_and_nothing_changes(tmp_path):
    with matrix.opened(tmp_path, cells(), "one"):
        pass
    before = (tmp_path / "study.json").read_bytes()
    other = cells(
        make=lambda task, algo: resolve(dg.Config(env=task, algo=algo, physics="native", gamma=0.9))
    )
    with (
        pytest.raises(
            ConfigError, match=r"^cell hopper-ppo-0: its gamma must be 0\.99 as in .*, not 0\.9"
        ),
        matrix.opened(tmp_path, other, ""),
    ):
        pass
    assert (tmp_path / "study.json").read_bytes() == before


def test_nobody_else_has_a_study_meanwhile(tmp_path):
    with (
        matrix.opened(tmp_path, cells(), "one"),
        pytest.raises(ConfigError, match="must not be in use"),
        matrix.opened(tmp_path, cells(), ""),
    ):
        pass


def test_a_directory_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with (
        pytest.raises(ConfigError, match="must be a study, or a new or empty directory"),
        matrix.opened(tmp_path, cells(), ""),
    ):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data | {"schema": 2}, "has schema 2, this version reads 1"),
        (
            lambda data: data | {"cells": {"../../hopper": data["cells"]["hopper-ppo-0"]}},
            "has no such name",
        ),
        (lambda data: data | {"cells": [1]}, "must be a study that can be read"),
        (lambda data: {}, "must be a study that can be read"),
    ],
)
def test_a_study_that_cannot_be_understood_is_refused(tmp_path, change, message):
    with matrix.opened(tmp_path, cells(), "one"):
        pass
    (tmp_path / "study.json").write_text(
        json.dumps(change(json.loads((tmp_path / "study.json").read_text())))
    )
    with pytest.raises(ConfigError, match=message):
        matrix.read(tmp_path)


def test_a_directory_without_a_study_is_none(tmp_path):
    with pytest.raises(ConfigError, match="must be the directory of a study"):
        matrix.read(tmp_path)


def test_a_variant_takes_the_place_of_the_algorithm_in_the_name_of_a_cell():
    (cell,) = matrix.matrix(
        ["brax:ant"],
        ["kappa-0.1"],
        (3, 4),
        2,
        lambda task, kind: resolve(dg.Config(env=task, algo="dppo")),
    )
    assert (cell.name, cell.kind) == ("brax_ant-kappa-0.1-3-4", "kappa-0.1")
    assert [cell.kind for cell in cells((0,))] == ["ppo", "dppo", "ppo", "dppo"]


def test_every_variant_of_a_question_is_a_configuration_of_its_own():
    for question in VARIANTS:
        arguments, rest = parse_known(
            reproduce.Arguments,
            "",
            ["study", "--variants", question, "--envs", "hopper", "--seeds", "0"],
            rest=reproduce.REST,
        )
        found, _ = reproduce._cells(arguments, rest)
        assert [cell.kind for cell in found] == list(VARIANTS[question])
        assert len({json.dumps(to_dict(cell.config)) for cell in found}) == len(found)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "--variants luck",
            "variants luck: must be one of attribution, attribution-noise, calibration, risk",
        ),
        ("--variants risk --algos ppo", "algos ppo: must be left out with --variants"),
        (
            "--variants calibration --critic.target bellman",
            "--critic.target: must be left out with --variants calibration",
        ),
        (
            "--variants attribution --critic.kappa=0.5",
            "--critic.kappa: must be left out with --variants attribution, whose variants set it",
        ),
        (
            "--variants risk --config best.json",
            "config best.json: must be left out with --variants",
        ),
    ],
)
def test_variants_have_algorithms_of_their_own(words, message):
    arguments, rest = parse_known(
        reproduce.Arguments, "", ["study", *words.split()], rest=reproduce.REST
    )
    with pytest.raises(ConfigError, match=message):
        reproduce._cells(arguments, rest)


def test_with_noise_the_variants_have_the_names_that_a_report_gives_them_and_its_mark():
    assert [name.removesuffix("+noise") for name in VARIANTS["attribution-noise"]] == list(
        VARIANTS["attribution"]
    )
    for variants in VARIANTS.values():
        assert all(
            name.endswith("+noise") == ("--noise." in words) for name, words in variants.items()
        )
