"""Checkpoints: round trip, damage, other runs, networks alone."""

import dataclasses
import json

import chex
import jax
import msgpack
import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.serial import to_dict
from dgae_jax.run import checkpoint, files
from dgae_jax.run.checkpoint import CheckpointError, NotFiniteError
from tests.helpers import signed
from tests.runs import SMALL, saved


def names(directory):
    return [int(path.stem.removeprefix("steps_")) for path in checkpoint.checkpoints_in(directory)]


def plain(state):
    return jax.device_get(state._replace(key=jax.random.key_data(state.key)))


def test_state_comes_back_bit_for_bit(state, tmp_path):
    path = saved(state, tmp_path, 0)
    loaded = checkpoint.load(path, state, SMALL)
    assert np.isnan(loaded.episodes.last_total).all()  # as before the first return
    chex.assert_trees_all_equal(plain(loaded), plain(state))
    chex.assert_trees_all_equal_shapes_and_dtypes(loaded, state)
    assert checkpoint.read(path)[0] == SMALL


def schema(number):
    return lambda b: b.replace(b'"schema": 4', f'"schema": {number}'.encode())


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda b: b[:100], "is damaged"),
        (lambda b: b[:-9] + b"x" + b[-8:], "is damaged"),
        (lambda b: signed(b"\x93\x01\xa1a\x02"), "is damaged"),
        (schema(5), "has schema 5, must be 3 or 4"),
        (schema(2), "has schema 2, must be 3 or 4"),
        (
            lambda b: signed(b.partition(b"\n")[2].replace(b"critic.", b"cretic.")),
            "is of another run, critic.* is missing",
        ),
    ],
)
def test_damaged_file_is_refused(damage, reason, state, tmp_path):
    path = saved(state, tmp_path, 64)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(CheckpointError, match=f"{path.name}: {reason}"):
        checkpoint.load(path, state, SMALL)


def array(shape=(2,), dtype="float32", data=bytes(8)):
    return msgpack.ExtType(1, msgpack.packb((shape, dtype, data)))


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (["x", 1], "a is missing"),
        (array(shape=(1, 2)), r"a is float32\(1, 2\), here float32\(2,\)"),
        (array(dtype="int32"), r"a is int32\(2,\), here float32\(2,\)"),
        (array(shape=(2**40,)), "is damaged"),
        (array(dtype="object"), "is damaged"),
        (array(data=[0] * 10_000), "is damaged"),
    ],
)
def test_array_that_was_not_written_so_is_refused(value, reason, tmp_path):
    path = tmp_path / "steps_000000000000.msgpack"
    config = json.dumps(to_dict(SMALL))
    path.write_bytes(signed(msgpack.packb({"arrays": {"a": value}, "config": config})))
    with pytest.raises(CheckpointError, match=reason):
        checkpoint.load(path, {"a": np.zeros(2, np.float32)}, SMALL)


def test_part_is_loaded_without_the_rest(tmp_path):
    a, c = np.ones(2, np.float32), np.arange(3, dtype=np.int32)
    path = tmp_path / "x.msgpack"
    checkpoint.write(path, SMALL, {"a": a, "b": np.full(3, np.nan), "c": c})
    chex.assert_trees_all_equal(checkpoint.load(path, {"a": a, "c": c}, SMALL), {"a": a, "c": c})


@pytest.mark.parametrize(
    ("where", "value"),
    [("policy.params", np.nan), ("critic.opt_state.1.0.mu", np.inf), ("obs_stats.std", np.nan)],
)
def test_nonfinite_state_is_neither_saved_nor_loaded(where, value, state, tmp_path):
    arrays, path = checkpoint.arrays_of(state), tmp_path / "x.msgpack"
    next(x for name, x in arrays.items() if name.startswith(where)).flat[0] = value
    with pytest.raises(NotFiniteError, match=rf"^{where}\S* is not finite after 64 samples"):
        checkpoint.save(tmp_path, SMALL, arrays, 64)
    assert list(tmp_path.iterdir()) == []
    checkpoint.write(path, SMALL, arrays)
    with pytest.raises(NotFiniteError, match=rf"{path.name}: {where}\S* is not finite"):
        checkpoint.load(path, state, SMALL)


def test_latest_and_best_checkpoints_stay(state, tmp_path):
    for steps in (64, 128, 6400, 9600):
        saved(state, tmp_path, steps, keep=2, best=64)
    assert names(tmp_path) == [64, 6400, 9600]
    saved(state, tmp_path, 12800, keep=2, best=9600)
    assert names(tmp_path) == [9600, 12800]
    saved(state, tmp_path, 6400, keep=1)  # the run went back behind damaged ones
    assert names(tmp_path) == [6400, 9600, 12800]


def test_checkpoint_of_another_run_is_refused(state, tmp_path):
    path = saved(state, tmp_path, 64)
    other = r"its env_version is v4, here v5"  # arrays of the same shapes
    with pytest.raises(CheckpointError, match=f"{path.name}: is of another run, {other}"):
        checkpoint.load(path, state, dataclasses.replace(SMALL, env_version="v5"))
    checkpoint.load(path, state, dataclasses.replace(SMALL, total_steps=9999, physics="jax"))
    path.write_bytes(signed(path.read_bytes().partition(b"\n")[2].replace(b"gamma", b"gemma")))
    with pytest.raises(CheckpointError, match=r"is of another version \(gamma: missing\)"):
        checkpoint.load(path, state, SMALL)


def test_damaged_checkpoint_falls_back_to_older_one(state, tmp_path, capsys):
    directory = tmp_path / "checkpoints"
    directory.mkdir()
    whole, damaged = (saved(state, directory, steps) for steps in (64, 128))
    damaged.write_bytes(damaged.read_bytes()[:-1])
    _, path = checkpoint.latest_train_state(tmp_path, SMALL)
    assert path == whole
    why = f"{damaged}: is damaged (its checksum differs)"
    assert capsys.readouterr().err == f"warning: {why}; skipped\n"
    assert [found.path for found in checkpoint.networks_in(tmp_path, SMALL)] == [whole]
    whole.unlink()
    with pytest.raises(CheckpointError, match="must hold a whole checkpoint"):
        checkpoint.latest_train_state(tmp_path, SMALL)


def test_best_checkpoint_is_that_of_the_best_evaluation(state, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    paths = [saved(state, tmp_path / "checkpoints", steps) for steps in (64, 128)]
    assert checkpoint.load_networks(tmp_path, SMALL, "latest").path == paths[1]
    with pytest.raises(ConfigError, match=r"checkpoint best: must be latest: .* no evaluations"):
        checkpoint.load_networks(tmp_path, SMALL, "best")
    rows = [{"steps": n, "seed": 0, "return_mean": 200 - n, "return_std": 0} for n in (64, 128)]
    files.append_rows(tmp_path / "evaluations.jsonl", rows)
    found = checkpoint.load_networks(tmp_path, SMALL, "best")
    assert found.path == paths[0]
    chex.assert_trees_all_equal(found.critic.params, state.critic.params)
