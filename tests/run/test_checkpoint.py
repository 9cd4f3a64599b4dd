"""Checkpoints: round trip, damage, other runs, networks alone."""

import dataclasses
import json
import tracemalloc

import chex
import jax
import msgpack
import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import checkpoint, directory, logger
from dgae_jax.run.checkpoint import CheckpointError, NotFiniteError
from dgae_jax.run.evaluation import evaluate_run
from dgae_jax.run.training import train_command
from tests.helpers import signed
from tests.runs import QUIET, SMALL, saved, small


def names(directory):
    return [int(path.stem.removeprefix("steps_")) for path in checkpoint.checkpoints_in(directory)]


def plain(state):
    return jax.device_get(state._replace(key=jax.random.key_data(state.key)))


def test_state_comes_back_bit_for_bit(state, tmp_path):
    path = saved(state, tmp_path, 0)
    loaded = checkpoint.load(path, state)
    chex.assert_trees_all_equal(plain(loaded), plain(state))
    chex.assert_trees_all_equal_shapes_and_dtypes(loaded, state)
    assert checkpoint.config_of(path) == SMALL


def schema(number):
    return lambda b: b.replace(b'"schema": 4', f'"schema": {number}'.encode())


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda b: b[:100], "is damaged"),
        (lambda b: b"", "is damaged"),
        (lambda b: b"\x93\x01\xa1a\x02", "is damaged"),
        (lambda b: b[:-9] + b"x" + b[-8:], "is damaged"),
        (lambda b: signed(b"\x93\x01\xa1a\x02"), "is damaged"),
        (lambda b: signed(b"\x81\xa1a\xc1"), "is damaged"),
        (schema("1e999"), "is damaged"),
        (schema("true"), "is damaged"),
        (schema(5), "has schema 5, must be at most 4: it is of a newer version"),
        (schema(2), "has schema 2, must be at most 4: its envs drew random numbers"),
        (schema(1), "has schema 1, must be at most 4: what it calls physics mjx"),
        (
            lambda b: signed(b.partition(b"\n")[2].replace(b"critic.", b"cretic.")),
            "is of another run, cretic.* is unknown here",
        ),
    ],
)
def test_damaged_file_is_refused(damage, reason, state, tmp_path):
    path = saved(state, tmp_path, 64)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(CheckpointError, match=f"{path.name}: {reason}"):
        checkpoint.load(path, state)


def array(shape=(2,), dtype="float32", data=bytes(8)):
    return msgpack.ExtType(checkpoint.ARRAY, msgpack.packb((shape, dtype, data)))


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        # np.asarray makes 15,001 × 100,000 characters of 4 bytes of it: 6 GB
        (["x" * 100_000, *[""] * 15_000], "is damaged"),
        ([[[]] * 50_000], "is damaged"),
        ({"a": 1}, "is damaged"),
        ("x", "is damaged"),
        (msgpack.ExtType(2, b"x"), "is damaged"),
        (msgpack.ExtType(1, b""), "is damaged"),
        (array(shape=(2**40,)), r"a is float32\(1099511627776,\), here float32\(2,\)"),
        (array(shape=(1,) * 40), "is damaged"),
        (array(shape=("2",)), "is damaged"),
        (array(shape=[[[]] * 50_000]), "is damaged"),
        (array(dtype="<U100000"), r"a is <U100000\(2,\), here float32\(2,\)"),
        (array(dtype="object"), r"a is object\(2,\), here float32\(2,\)"),
        (array(data=bytes(4)), "is damaged"),
        (array(data=[0] * 10_000), "is damaged"),
    ],
)
def test_hostile_array_is_refused_before_it_takes_memory(value, reason, tmp_path):
    data = signed(msgpack.packb({"arrays": {"a": value}, "config": "{}"}))
    path = tmp_path / "steps_000000000000.msgpack"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(CheckpointError, match=reason):
            checkpoint.load(path, {"a": np.zeros(2, np.float32)})
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20 * len(data) + 2**22


def test_part_is_loaded_without_the_rest(tmp_path):
    a, c = np.ones(2, np.float32), np.arange(3, dtype=np.int32)
    path = tmp_path / "x.msgpack"
    checkpoint.write(path, SMALL, {"a": a, "b": np.full(3, np.nan), "c": c})
    got = checkpoint.load(path, {"a": a, "c": c}, part=True)
    chex.assert_trees_all_equal(got, {"a": a, "c": c})
    with pytest.raises(CheckpointError, match="is of another run, b is unknown here"):
        checkpoint.load(path, {"a": a, "c": c})
    with pytest.raises(CheckpointError, match="is of another run, d is missing"):
        checkpoint.load(path, {"a": a, "d": c}, part=True)
    with pytest.raises(CheckpointError, match=r"a is float32\(2,\), here int32\(3,\)"):
        checkpoint.load(path, {"a": c}, part=True)


def broken(state, where, value):
    """Replace one number of the state."""
    leaves, tree = jax.tree.flatten(state)
    named = [checkpoint._name(path) for path, _ in jax.tree.leaves_with_path(state)]
    at = next(i for i, name in enumerate(named) if name.startswith(where))
    leaves[at] = leaves[at].at[(0,) * leaves[at].ndim].set(value)
    return jax.tree.unflatten(tree, leaves)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["policy.params", "critic.opt_state.1.0.mu", "obs_stats.std"])
def test_nonfinite_state_is_neither_saved_nor_loaded(where, value, state, tmp_path):
    with pytest.raises(NotFiniteError, match=rf"^{where}\S* is not finite after 64 samples"):
        saved(broken(state, where, value), tmp_path, 64)
    assert list(tmp_path.iterdir()) == []
    path = tmp_path / "x.msgpack"
    checkpoint.write(path, SMALL, checkpoint.arrays_of(broken(state, where, value)))
    with pytest.raises(NotFiniteError, match=rf"{path.name}: {where}\S* is not finite"):
        checkpoint.load(path, state)


def test_episodes_may_be_nan(state, tmp_path):
    loaded = checkpoint.load(saved(broken(state, "episodes.env", np.nan), tmp_path, 0), state)
    assert np.isnan(loaded.episodes.last_total).all()


def test_latest_and_best_checkpoints_stay(state, tmp_path):
    for steps in (64, 128, 6400, 9600):
        saved(state, tmp_path, steps, keep=2, best=64)
    assert names(tmp_path) == [64, 6400, 9600]
    saved(state, tmp_path, 12800, keep=2, best=9600)
    assert names(tmp_path) == [9600, 12800]
    saved(state, tmp_path, 6400, keep=1)  # the run went back behind damaged ones
    assert names(tmp_path) == [6400, 9600, 12800]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"env_version": "v5"}, r"its env_version is v4, here v5"),  # arrays of the same shapes
        (
            {"policy": dataclasses.replace(SMALL.policy, hidden=(9,))},
            r"its policy\.hidden is \(8,\), here \(9,\)",
        ),
    ],
)
def test_checkpoint_of_another_run_is_refused(change, reason, state, tmp_path):
    path = saved(state, tmp_path, 64)
    with pytest.raises(CheckpointError, match=f"{path.name}: is of another run, {reason}"):
        checkpoint.load_train_state(path, dataclasses.replace(SMALL, **change))
    checkpoint.load_train_state(path, dataclasses.replace(SMALL, total_steps=9999, physics="jax"))
    path.write_bytes(signed(path.read_bytes().partition(b"\n")[2].replace(b"gamma", b"gemma")))
    with pytest.raises(CheckpointError, match=r"is of another version \(gamma: missing\)"):
        checkpoint.load_train_state(path, SMALL)


def test_renamed_or_missing_checkpoint_is_refused(state, tmp_path):
    path = saved(state, tmp_path, 64).rename(tmp_path / "steps_000000000128.msgpack")
    with pytest.raises(CheckpointError, match="is renamed, it was saved after 1 iterations"):
        checkpoint.load_train_state(path, SMALL)
    with pytest.raises(CheckpointError, match="must hold a checkpoint"):
        checkpoint.latest_train_state(tmp_path, SMALL)


def test_damaged_checkpoint_falls_back_to_older_one(state, tmp_path, capsys):
    directory = tmp_path / "checkpoints"
    directory.mkdir()
    whole, damaged = (saved(state, directory, steps) for steps in (64, 128))
    damaged.write_bytes(damaged.read_bytes()[:-1])
    (directory / "steps_000000000192.msgpack").symlink_to(whole)  # not followed
    _, path = checkpoint.latest_train_state(tmp_path, SMALL)
    assert path == whole
    why = f"{damaged}: is damaged (its checksum differs)"
    assert capsys.readouterr().err == f"warning: {why}; falling back to {whole.name}\n"
    whole.unlink()
    with pytest.raises(CheckpointError, match="its checksum differs"):
        checkpoint.latest_train_state(tmp_path, SMALL)


def test_best_checkpoint_stays_and_is_evaluated(tmp_path, monkeypatch):
    config, run_dir = small(), tmp_path / "run"
    options = dataclasses.replace(QUIET, run_dir=run_dir, checkpoint_every=128, keep_checkpoints=1)
    scores = iter([1.0, 5.0, 3.0, 2.0])
    honest = logger.evaluate_policies

    def scored(policies, config, **how):
        score = {"seed": 0, "return_mean": next(scores), "return_std": 0.0, "returns": []}
        return {**honest(policies, config, **how), "seeds": [score]}

    monkeypatch.setattr(logger, "evaluate_policies", scored)
    assert train_command(config, options) == 0
    assert names(run_dir / "checkpoints") == [256, 512]
    best, latest = (
        evaluate_run(run_dir, config, which=which, engine="gymnasium", episodes=1)
        for which in ("best", "latest")
    )
    files = best["checkpoint"], latest["checkpoint"]
    assert files == ("steps_000000000256.msgpack", "steps_000000000512.msgpack")
    then = json.loads((run_dir / "evaluation.json").read_text())
    assert latest["returns"] == then["returns"]
    (run_dir / "evaluations.jsonl").unlink()
    with pytest.raises(ConfigError, match=r"checkpoint best: must be latest: .* no evaluations"):
        evaluate_run(run_dir, config, which="best", engine="gymnasium", episodes=1)


def test_nonfinite_checkpoint_is_neither_resumed_nor_evaluated(run_dir):
    config = directory.read_config(run_dir)
    state, path = checkpoint.latest_train_state(run_dir, config)
    arrays = checkpoint.arrays_of(broken(state, "policy.params", np.nan))
    checkpoint.write(path, config, arrays)
    reason = rf"{path.name}: policy\.params\.\S+ is not finite"
    with pytest.raises(CheckpointError, match=reason):
        train_command(small(), dataclasses.replace(QUIET, resume=run_dir))
    with pytest.raises(CheckpointError, match=reason):
        evaluate_run(run_dir, config, which="latest", episodes=1)


def test_networks_are_loaded_without_the_rest_of_the_state(state, tmp_path):
    arrays, needed = checkpoint.arrays_of(state), ("policy.params", "critic.params", "obs_stats")
    rest = {name: np.zeros(3) for name in arrays if not name.startswith(needed)}
    (tmp_path / "checkpoints").mkdir()
    checkpoint.save(tmp_path / "checkpoints", SMALL, {**arrays, **rest}, 64)
    found = checkpoint.load_networks(tmp_path, SMALL, "latest")
    chex.assert_trees_all_equal(found.policy.params, state.policy.params)
    chex.assert_trees_all_equal(found.critic.params, state.critic.params)
    with pytest.raises(CheckpointError, match="is of another run"):
        checkpoint.latest_train_state(tmp_path, SMALL)
