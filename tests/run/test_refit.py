"""A value distribution that is fitted to the returns of a policy held fixed."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dgae_jax as dg
from dgae_jax.maths.transport import quantile_midpoints
from dgae_jax.run import calibration, checkpoint, directory, training
from tests import helpers, runs

POLICY = helpers.ROOT / "results" / "tuned" / "policies" / "hopper-dppo-1.msgpack"
"""Of the table of results."""


def quantiles_after(obs, outcome):
    samples = calibration.Samples(obs[:, None], outcome)
    network = calibration.initial_network(samples, 16, hidden=(32,))
    params = calibration.fit_quantiles(network, samples, 200, jax.random.key(2))
    return network.apply(params, jnp.array([[-1.0], [1.0]]))


@pytest.mark.parametrize("lowest", [0.0, -1_500.0, 1_500.0], ids="{:+.0f}".format)
def test_quantiles_of_returns_that_are_uniform_above_a_bound_are_that_and_midpoints_times_their_range(
    lowest,
):
    # F⁻¹(τ) = l + cτ of a uniform variable on l … l + c; here c is 1 in one state, 3 in the other
    which, height = (jax.random.uniform(jax.random.key(i), (20_000,)) for i in range(2))
    obs = jnp.where(which < 0.5, -1.0, 1.0)
    found = quantiles_after(obs, lowest + height * (2 + obs))
    expected = lowest + jnp.array([[1.0], [3.0]]) * quantile_midpoints(16)
    np.testing.assert_allclose(found, expected, atol=0.06)


def test_a_return_that_is_lost_one_time_in_four_is_lost_in_one_quantile_in_four():
    # one state pays 1, the other 1 with probability ¾ and else 0: F⁻¹ is 0 up to ¼ and 1 beyond
    which, luck = (jax.random.uniform(jax.random.key(i), (20_000,)) for i in range(2))
    obs = jnp.where(which < 0.5, -1.0, 1.0)
    found = quantiles_after(obs, jnp.where((obs > 0) & (luck < 0.25), 0.0, 1.0))
    assert np.abs(found[0] - 1).max() < 0.1
    np.testing.assert_allclose(found[1], [0.0] * 4 + [1.0] * 12, atol=0.15)


@pytest.mark.slow  # programs of their own are compiled
@pytest.mark.parametrize("algo", ["ppo", "dppo"])
def test_the_policy_stays_as_it_is_and_the_file_is_loaded_calibrated_and_refitted_to_the_same_bits(
    algo, tmp_path, monkeypatch, capsys
):
    training.train(
        runs.small(algo, seeds=2), dataclasses.replace(runs.QUIET, run_dir=tmp_path / "run")
    )
    config = directory.read_config(tmp_path / "run")

    def dgae(name, *argv):
        monkeypatch.setattr(
            "sys.argv", [f"dgae {name}", *map(str, argv), "--cache-dir", runs.QUIET.cache_dir]
        )
        assert helpers.command(name)() == 0
        return capsys.readouterr().out

    made = ("--index", "1", "--worlds", "16")
    file = tmp_path / "run" / "refit.msgpack"
    assert f"fitted to {16 * calibration.CHUNK:,} returns" in dgae("refit", tmp_path / "run", *made)
    whole, alone = (dg.load_policy(tmp_path / "run", seed=1), dg.load_policy(file))
    obs = np.random.default_rng(0).normal(size=(100, 11))
    np.testing.assert_array_equal(alone(obs), whole(obs))
    assert alone.quantiles(obs).shape == (100, 8 if algo == "dppo" else 64)
    assert (np.diff(alone.quantiles(obs)) >= 0).all()

    after = directory.config_of(file)
    assert (after.seed, after.num_seeds, after.critic.kind) == (config.seed + 1, 1, "sorted")
    assert checkpoint.reward_std(file, after) > 0
    dgae("calibrate", file)
    found = json.loads((tmp_path / "run" / "refit-calibration.json").read_text())["refit.msgpack"]
    assert found["crossing"] == 0
    assert np.isfinite([*found["pit"], found["rmse"], found["crps"]]).all()

    before = file.read_bytes()
    dgae("refit", tmp_path / "run", *made)
    assert file.read_bytes() == before
    dgae("refit", file, "--worlds", "16", "--out", tmp_path / "again.msgpack")
    np.testing.assert_array_equal(dg.load_policy(tmp_path / "again.msgpack")(obs), whole(obs))


ALLOWED = "a file whose name ends in .msgpack, not the policy's own and not among the checkpoints of a run"


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["nowhere"], "nowhere: must be a run directory; there is nothing of that name"),
        (["run", "--worlds", "0"], "--worlds 0: must be a whole number from 1 to 10,000"),
        (
            ["run", "--seed", "-1"],
            "--seed -1: must be a whole number from 0 to 2,147,483,647 (an int32)",
        ),
        (
            ["run", "--index", "1"],
            "--index 1: must be a whole number from 0 to 0, the index of a seed in run",
        ),
        (
            ["run", "--out", "there/x.msgpack"],
            "--out there/x.msgpack: must be a file in a directory that exists",
        ),
        (["run", "--out", "run"], "--out run: must be a file, not a directory, a link or a device"),
        (["run", "--out", "run/config.json"], f"--out run/config.json: must be {ALLOWED}"),
        (
            ["run", "--out", "run/checkpoints/x.msgpack"],
            f"--out run/checkpoints/x.msgpack: must be {ALLOWED}",
        ),
        (
            ["a" * 300],
            f"{'a' * 300}: must be a run directory, or the file of a policy (File name too long)",
        ),
        (
            ["run", "--out", "a" * 300],
            f"--out {'a' * 300}: must be a file that can be written (File name too long)",
        ),
        (
            ["far"],
            "--gamma 0.99999: must be at most 0.9999, so that returns can be followed to their end",
        ),
        (
            ["cut"],
            "--env gymnasium:Pendulum-v1: must be a task without a time limit of its own, which cuts returns short",
        ),
    ],
)
def test_what_cannot_be_fitted_is_refused_in_one_line(argv, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    directory.create(tmp_path / "run", runs.small("ppo"), runs.QUIET)
    directory.create(
        tmp_path / "far", dataclasses.replace(runs.small("ppo"), gamma=0.99999), runs.QUIET
    )
    pendulum = {"env": "gymnasium:Pendulum-v1", "env_version": None, "physics": "gymnasium"}
    directory.create(
        tmp_path / "cut", dataclasses.replace(runs.small("ppo"), **pendulum), runs.QUIET
    )
    monkeypatch.setattr("sys.argv", ["dgae refit", *argv])
    with pytest.raises(SystemExit, match="2"):
        helpers.command("refit")()
    assert capsys.readouterr().err == f"error: {message}\n"


def test_a_policy_is_not_written_over_by_its_own_refit(tmp_path, monkeypatch, capsys):
    file = tmp_path / "policy.msgpack"
    shutil.copy(POLICY, file)
    monkeypatch.setattr("sys.argv", ["dgae refit", str(file), "--out", str(file)])
    with pytest.raises(SystemExit, match="2"):
        helpers.command("refit")()
    assert capsys.readouterr().err == f"error: --out {file}: must be {ALLOWED}\n"
    assert file.read_bytes() == POLICY.read_bytes()


def test_a_file_without_the_scale_of_its_rewards_is_not_compared_with_returns(
    monkeypatch, capsys, tmp_path
):
    config, file = directory.config_of(POLICY), tmp_path / "old.msgpack"
    policy, critic, _ = checkpoint.load_networks(POLICY, config, "latest")
    networks = {
        "policy": {"params": policy.params},
        "critic": {"params": critic.params},
        "observations": policy.observations,
    }
    checkpoint.write(file, config, checkpoint.arrays_of(networks))
    monkeypatch.setattr("sys.argv", ["dgae calibrate", str(file), "--out", str(tmp_path / "x.png")])
    with pytest.raises(SystemExit, match="2"):
        helpers.command("calibrate")()
    assert (
        capsys.readouterr().err
        == f"error: {file}: does not say what rewards were divided by; dgae refit fits a critic that does\n"
    )
