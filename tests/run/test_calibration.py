"""Critics against the returns that came."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from dgae_jax.cli import evaluate
from dgae_jax.maths.transport import quantile_midpoints
from dgae_jax.report import figures
from dgae_jax.run import calibration, directory, training
from tests import helpers, runs

UNIFORM = jnp.tile(quantile_midpoints(100), (1000, 1, 1))
"""Of returns that are uniform on 0 … 1."""
RETURNS = ((jnp.arange(1000) + 0.5) / 1000)[:, None]


def test_a_critic_that_knows_the_distribution_is_calibrated():
    found = calibration.statistics(UNIFORM, RETURNS)
    assert found["coverage_90"] == pytest.approx(0.9, abs=0.002)
    assert found["pit"] == pytest.approx([1 / calibration.BINS] * calibration.BINS, abs=0.011)
    assert sum(found["pit"]) == pytest.approx(1)
    # the mean is 1/2 and a uniform variable has standard deviation 1/√12
    assert (found["crossing"], found["bias"]) == pytest.approx((0, 0), abs=1e-6)
    assert (found["rmse"], found["spread"]) == pytest.approx((12**-0.5, 12**-0.5), abs=1e-4)


def test_a_critic_half_as_wide_holds_half_of_the_returns_and_leaves_the_rest_at_both_ends():
    found = calibration.statistics(0.25 + UNIFORM / 2, RETURNS)
    assert found["coverage_90"] == pytest.approx(0.45, abs=0.002)
    assert found["pit"][0] == pytest.approx(found["pit"][-1], abs=0.011)
    assert found["pit"][0] + found["pit"][-1] == pytest.approx(0.55, abs=0.02)


def test_neighbours_in_the_wrong_order_are_counted():
    assert calibration.statistics(UNIFORM[..., ::-1], RETURNS)["crossing"] == 1


def test_means_are_similar_where_target_and_prediction_differ_in_shape_alone():
    reward, discount = jnp.zeros((4, 1)), jnp.ones((4, 1))
    # of two quantiles: twice as wide (d = 0, W₁ = 1), moved by 1 (d = W₁ = 1), moved by −1 on one side and 0.95 on the other
    quantiles = jnp.array([[-1.0, 1.0], [-2.0, 2.0], [-1.0, 3.0], [-2.0, 3.95]])[:, None]
    # d = (−1 + 0.95) / 2 = −0.025 and W₁ = 0.975 in the last step, a share of 0.0256
    assert calibration.similar(reward, discount, quantiles) == pytest.approx(
        {"0.1": 2 / 3, "0.03": 2 / 3, "0.01": 1 / 3, "0.003": 1 / 3}, abs=1e-6
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algo": "ppo"}, "must be a run with a value distribution, not ppo"),
        (
            {"algo": "dppo", "gamma": 0.99999},
            "gamma 0.99999: must be at most 0.9999, so that returns can be followed to their end",
        ),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_line(
    changes, message, tmp_path, monkeypatch, capsys
):
    gamma = changes.pop("gamma", 0.99)
    directory.create(
        tmp_path / "run", dataclasses.replace(runs.small(**changes), gamma=gamma), runs.QUIET
    )
    monkeypatch.setattr("sys.argv", ["dgae calibrate", str(tmp_path / "run")])
    with pytest.raises(SystemExit, match="2"):
        helpers.command("calibrate")()
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("x.pdf", "--out x.pdf: must be a file whose name ends in .png"),
        ("there/x.png", "--out there/x.png: must be a file in a directory that exists"),
        (
            "taken.png",
            "--out taken.json: must be a file, not a directory, a link or a device",
        ),  # where the statistics would go
    ],
)
def test_a_picture_that_cannot_be_written_is_refused_before_anything_is_played(
    out, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.json").mkdir()
    directory.create(tmp_path / "run", runs.small("dppo"), runs.QUIET)
    monkeypatch.setattr("sys.argv", ["dgae calibrate", "run", "--out", out])
    with pytest.raises(SystemExit, match="2"):
        helpers.command("calibrate")()
    assert message in capsys.readouterr().err


def test_the_critics_of_all_kinds_of_quantiles_can_be_compared(tmp_path):
    plain = runs.small("dppo")
    kinds = ("quantile", "sorted", "ordered")
    made = {
        kind: dataclasses.replace(plain, critic=dataclasses.replace(plain.critic, kind=kind))
        for kind in kinds
    }
    for name, config in made.items():
        directory.create(tmp_path / name, config, runs.QUIET)
    paths = tuple(tmp_path / name for name in made)
    configs, _ = evaluate._check_calibrate(evaluate.CalibrateArguments(run_dirs=paths))
    assert tuple(config.critic.kind for config in configs) == kinds


def test_runs_of_the_same_name_are_refused(tmp_path, monkeypatch, capsys):
    for parent in ("a", "b"):
        directory.create(tmp_path / parent / "run", runs.small("dppo"), runs.QUIET)
    monkeypatch.setattr(
        "sys.argv", ["dgae calibrate", *(str(tmp_path / parent / "run") for parent in ("a", "b"))]
    )
    with pytest.raises(SystemExit, match="2"):
        helpers.command("calibrate")()
    assert "RUN_DIRS run run: must have different names" in capsys.readouterr().err


@pytest.mark.slow  # a program of its own is compiled
def test_the_command_writes_the_statistics_of_every_run_and_a_picture(
    tmp_path, monkeypatch, capsys
):
    training.train(runs.small("dppo"), dataclasses.replace(runs.QUIET, run_dir=tmp_path / "run"))
    monkeypatch.setattr(
        "sys.argv", ["dgae calibrate", str(tmp_path / "run"), "--cache-dir", runs.QUIET.cache_dir]
    )
    assert helpers.command("calibrate")() == 0
    found = json.loads((tmp_path / "run" / "calibration.json").read_text())["run"]
    assert (
        found["samples"] == calibration.WORLDS * calibration.CHUNK
    )  # episodes of 20 steps, in whole chunks
    assert np.isfinite(
        [*found["pit"], found["rmse"], found["crps"], *found["similar_means"].values()]
    ).all()
    assert (tmp_path / "run" / "calibration.png").read_bytes().startswith(b"\x89PNG")
    assert "run: fewer than 10 quantiles have no central 90 %, " in capsys.readouterr().out


def test_what_is_said_of_coverage_is_a_share_where_there_are_enough_quantiles():
    assert figures.coverage({"coverage_90": 0.874}) == "87 % of the returns in the central 90 %"
    assert (
        figures.coverage(calibration.statistics(UNIFORM[..., :9], RETURNS))
        == "fewer than 10 quantiles have no central 90 %"
    )
