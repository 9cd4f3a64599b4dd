"""The checkpoints of a run directory."""

import dataclasses
import json

import chex
import jax
import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import checkpoint, directory, logger
from dgae_jax.run.checkpoint import CheckpointError
from dgae_jax.run.evaluation import evaluate_run
from dgae_jax.run.training import train_command
from tests.helpers import signed
from tests.runs import QUIET, SMALL, saved, small


def test_the_newest_checkpoints_are_kept_and_the_best(state, tmp_path):
    directory = tmp_path / "checkpoints"
    directory.mkdir()
    for steps in (64, 128, 6400, 9600):
        saved(state, directory, steps, keep=2, best=64)
    assert [p.name for p in checkpoint.checkpoints_in(directory)] == [
        f"steps_{steps:012d}.msgpack" for steps in (64, 6400, 9600)
    ]
    assert checkpoint.latest_train_state(tmp_path, SMALL)[1].name == "steps_000000009600.msgpack"
    saved(state, directory, 12800, keep=2, best=9600)
    assert [p.name for p in checkpoint.checkpoints_in(directory)] == [
        f"steps_{steps:012d}.msgpack" for steps in (9600, 12800)
    ]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"env_version": "v5"}, r"its env_version is v4, here v5"),  # arrays of the same shapes
        ({"env": "ant"}, r"its env is hopper, here ant"),
        (
            {"policy": dataclasses.replace(SMALL.policy, hidden=(9,))},
            r"its policy\.hidden is \(8,\), here \(9,\)",
        ),
    ],
)
def test_a_checkpoint_of_another_environment_or_network_is_refused_by_both_values(
    change, reason, state, tmp_path
):
    path = saved(state, tmp_path, 64)
    with pytest.raises(CheckpointError, match=f"{path.name}: is of another run, {reason}"):
        checkpoint.load_train_state(path, dataclasses.replace(SMALL, **change))
    checkpoint.load_train_state(path, dataclasses.replace(SMALL, total_steps=9999, physics="jax"))


def test_a_checkpoint_whose_configuration_has_other_names_is_of_another_version(state, tmp_path):
    path = saved(state, tmp_path, 0)
    path.write_bytes(signed(path.read_bytes().partition(b"\n")[2].replace(b"gamma", b"gemma")))
    with pytest.raises(CheckpointError, match=r"is of another version \(gamma: missing\)"):
        checkpoint.load_train_state(path, SMALL)


def test_a_renamed_checkpoint_is_refused(state, tmp_path):
    path = saved(state, tmp_path, 64).rename(tmp_path / "steps_000000000128.msgpack")
    with pytest.raises(CheckpointError, match="is renamed, it was saved after 1 iterations"):
        checkpoint.load_train_state(path, SMALL)


def test_a_directory_without_checkpoints_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="must hold a checkpoint"):
        checkpoint.latest_train_state(tmp_path, SMALL)


def test_a_damaged_checkpoint_gives_way_to_an_older_one_and_links_are_not_followed(
    state, tmp_path, capsys
):
    directory = tmp_path / "checkpoints"
    directory.mkdir()
    whole, broken = (saved(state, directory, steps) for steps in (64, 128))
    broken.write_bytes(broken.read_bytes()[:-1])
    (directory / "steps_000000000192.msgpack").symlink_to(whole)
    _, path = checkpoint.latest_train_state(tmp_path, SMALL)
    assert path == whole
    warning = f"warning: {broken}: is damaged (its checksum differs); linear_schedule back to {whole.name}\n"
    assert capsys.readouterr().err == warning
    whole.unlink()
    with pytest.raises(CheckpointError, match="its checksum differs"):
        checkpoint.latest_train_state(tmp_path, SMALL)


def test_the_best_checkpoint_stays_and_can_be_evaluated(tmp_path):
    config, run_dir = small(), tmp_path / "run"
    options = dataclasses.replace(QUIET, run_dir=run_dir, checkpoint_every=64, keep_checkpoints=1)
    scores = iter([1.0, 5.0, 3.0, 5.0, 2.0, 2.0, 2.0, 2.0])
    honest = logger.evaluate_policies

    def scored(policies, config, **how):
        score = {"seed": 0, "return_mean": next(scores), "return_std": 0.0, "returns": []}
        return {**honest(policies, config, **how), "seeds": [score]}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logger, "evaluate_policies", scored)
        assert train_command(config, options) == 0
    assert [p.name for p in checkpoint.checkpoints_in(run_dir / "checkpoints")] == [
        f"steps_{steps:012d}.msgpack" for steps in (256, 512)
    ]
    config = directory.read_config(run_dir)
    found = {
        which: evaluate_run(run_dir, config, which=which, engine="gymnasium", episodes=1)
        for which in ("best", "latest")
    }
    assert [found[which]["checkpoint"] for which in ("best", "latest")] == [
        "steps_000000000256.msgpack",
        "steps_000000000512.msgpack",
    ]
    assert (
        found["latest"]["returns"]
        == json.loads((run_dir / "evaluation.json").read_text())["returns"]
    )


def test_the_best_checkpoint_of_a_run_without_evaluations_is_refused(run_dir):
    (run_dir / "evaluations.jsonl").unlink()
    with pytest.raises(
        ConfigError, match=r"checkpoint best: must be latest: .* has no evaluations"
    ):
        evaluate_run(run_dir, small(), which="best", engine="gymnasium", episodes=1)


def test_a_run_whose_newest_checkpoint_is_not_finite_is_neither_resumed_nor_evaluated(run_dir):
    config = directory.read_config(run_dir)
    state, path = checkpoint.latest_train_state(run_dir, config)
    params = jax.tree.map(lambda x: x * np.nan, state.policy.params)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "not_finite", lambda arrays: [])
        checkpoint.save(
            path.parent,
            config,
            checkpoint.arrays_of(state._replace(policy=state.policy._replace(params=params))),
            512,
        )
    reason = rf"{path.name}: policy\.params\.\S+ is not finite: it can be neither continued nor evaluated"
    with pytest.raises(CheckpointError, match=reason):
        train_command(small(), dataclasses.replace(QUIET, resume=run_dir))
    with pytest.raises(CheckpointError, match=reason):
        evaluate_run(run_dir, config, which="latest", episodes=1)


def test_acting_takes_the_networks_and_the_statistics_of_a_checkpoint_and_nothing_else(
    state, tmp_path
):
    arrays = checkpoint.arrays_of(state)
    rest = {
        name: np.zeros(3)
        for name in arrays
        if not name.startswith(("policy.params", "critic.params", "observations"))
    }
    (tmp_path / "checkpoints").mkdir()
    checkpoint.save(tmp_path / "checkpoints", SMALL, {**arrays, **rest}, 64)
    found = checkpoint.load_networks(tmp_path, SMALL, "latest")
    chex.assert_trees_all_equal(found.policy.params, state.policy.params)
    chex.assert_trees_all_equal(found.critic.params, state.critic.params)
    with pytest.raises(CheckpointError, match="is of another run"):
        checkpoint.latest_train_state(tmp_path, SMALL)
