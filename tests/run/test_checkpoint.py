"""One checkpoint as a file."""

import tracemalloc

import chex
import jax
import msgpack
import numpy as np
import pytest

from dgae_jax.run import checkpoint
from dgae_jax.run.checkpoint import CheckpointError, NotFiniteError
from tests.helpers import signed
from tests.runs import SMALL, saved


def plain(state):
    return jax.device_get(state._replace(key=jax.random.key_data(state.key)))


def test_a_checkpoint_gives_the_state_back_bit_for_bit(state, tmp_path):
    loaded = checkpoint.load(saved(state, tmp_path, 0), state)
    chex.assert_trees_all_equal(plain(loaded), plain(state))
    chex.assert_trees_all_equal_shapes_and_dtypes(loaded, state)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda b: b[:100], "is damaged"),
        (lambda b: b"", "is damaged"),
        (lambda b: b"\x00" * 50, "is damaged"),
        (lambda b: b"\xa3abc", "is damaged"),
        (lambda b: b"\x93\x01\xa1a\x02", "is damaged"),
        (lambda b: b[:-9] + b"x" + b[-8:], "is damaged"),
        (
            lambda b: b.replace(b'"schema": 3', b'"schema": 4'),
            "has schema 4, of a newer version; this version reads schema 3",
        ),
        (
            lambda b: b.replace(b'"schema": 3', b'"schema": 2'),
            "has schema 2, this version reads schema 3: its worlds drew random numbers in another way; continue it with the version that "
            "wrote it, or train again",
        ),
        (
            lambda b: b.replace(b'"schema": 3', b'"schema": 1'),
            "has schema 1, this version reads schema 3: what it calls physics mjx is now called jax; continue it with the version that "
            "wrote it, or train again",
        ),
        (
            lambda b: signed(b.partition(b"\n")[2].replace(b"critic.", b"cretic.")),
            "is of another run, cretic.* is unknown here",
        ),
        (lambda b: b.replace(b'"schema": 3', b'"schema": 1e999'), "is damaged"),
        (lambda b: b.replace(b'"schema": 3', b'"schema": true'), "is damaged"),
        (lambda b: signed(b"\x93\x01\xa1a\x02"), "is damaged"),
        (lambda b: signed(b"\x81\xa1a\xc1"), "is damaged"),
    ],
)
def test_a_damaged_checkpoint_is_refused_by_name(damage, reason, state, tmp_path):
    path = saved(state, tmp_path, 64)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(CheckpointError, match=f"{path.name}: {reason}"):
        checkpoint.load(path, state)


def test_arrays_of_other_shapes_are_refused_by_name_whatever_configuration_they_claim(
    state, tmp_path
):
    arrays = checkpoint.arrays_of(state)
    name = next(name for name in arrays if name.startswith("policy.params"))
    path = checkpoint.save(tmp_path, SMALL, {**arrays, name: np.zeros((2, 2), np.float16)}, 0)
    with pytest.raises(
        CheckpointError, match=rf"is of another run, {name} is float16\(2, 2\), here float32\(1, "
    ):
        checkpoint.load(path, state)


def test_a_checkpoint_saved_behind_damaged_ones_is_kept(state, tmp_path):
    for steps in (64, 128, 192, 256):
        saved(state, tmp_path, steps, keep=9)
    for damaged in (192, 256):
        (tmp_path / f"steps_{damaged:012d}.msgpack").write_bytes(b"")
    saved(state, tmp_path, 160, keep=1)
    assert [int(p.stem[6:]) for p in checkpoint.checkpoints_in(tmp_path)] == [160, 192, 256]


def array(shape=(2,), dtype="float32", data=bytes(8)):
    return msgpack.ExtType(1, msgpack.packb((shape, dtype, data)))


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (
            ["x" * 100_000, *[""] * 15_000],
            "is damaged",
        ),  # np.asarray makes 15,001 × 100,000 characters of 4 bytes of it: 6 GB
        ([[[]] * 50_000], "is damaged"),
        ({"a": 1}, "is damaged"),
        ("x", "is damaged"),
        (7, "is damaged"),
        (msgpack.ExtType(2, b"x"), "is damaged"),
        (msgpack.ExtType(1, b""), "is damaged"),
        (array(shape=(2**40,)), r"a is float32\(1099511627776,\), here float32\(2,\)"),
        (array(shape=(1,) * 40), "is damaged"),
        (array(shape=("2",)), "is damaged"),
        (array(shape=[[[]] * 50_000]), "is damaged"),
        (array(dtype="<U100000"), r"a is <U100000\(2,\), here float32\(2,\)"),
        (array(dtype="object"), r"a is object\(2,\), here float32\(2,\)"),
        (array(dtype=["x"] * 10_000), "is damaged"),
        (array(data=bytes(4)), "is damaged"),
        (array(data=bytes(12)), "is damaged"),
        (array(data=[0] * 10_000), "is damaged"),
    ],
)
def test_what_is_not_the_expected_array_is_refused_before_it_takes_memory(value, reason, tmp_path):
    data, like = (
        signed(msgpack.packb({"arrays": {"a": value}, "config": "{}"})),
        {"a": np.zeros(2, np.float32)},
    )
    path = tmp_path / "steps_000000000000.msgpack"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(CheckpointError, match=reason):
            checkpoint.load(path, like)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20 * len(data) + 2**22


def test_a_part_of_a_checkpoint_is_loaded_without_a_look_at_the_rest(tmp_path):
    arrays = {
        "a": np.ones(2, np.float32),
        "b": np.full(3, np.nan),
        "c": np.arange(3, dtype=np.int32),
    }
    path = checkpoint.save(tmp_path, SMALL, {**arrays, "b": np.ones(3)}, 0)
    body = path.read_bytes().partition(b"\n")[2]
    path.write_bytes(signed(body.replace(np.ones(3).tobytes(), arrays["b"].tobytes())))
    got = checkpoint.load(path, {"a": arrays["a"], "c": arrays["c"]}, part=True)
    chex.assert_trees_all_equal(got, {"a": arrays["a"], "c": arrays["c"]})
    with pytest.raises(CheckpointError, match="is of another run, b is unknown here"):
        checkpoint.load(path, {"a": arrays["a"], "c": arrays["c"]})
    with pytest.raises(CheckpointError, match="is of another run, d is missing"):
        checkpoint.load(path, {"a": arrays["a"], "d": arrays["c"]}, part=True)


def broken(state, where, value):
    """The state with one number replaced."""
    leaves, tree = jax.tree.flatten(state)
    at = next(
        i
        for i, (path, _) in enumerate(jax.tree.leaves_with_path(state))
        if checkpoint._name(path).startswith(where)
    )
    leaves[at] = leaves[at].at[(0,) * leaves[at].ndim].set(value)
    return jax.tree.unflatten(tree, leaves)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(
    "where",
    [
        "policy.params",
        "policy.opt_state.1.0.mu",
        "critic.params",
        "observations.mean",
        "observations.std",
    ],
)
def test_a_state_that_is_not_finite_is_neither_saved_nor_loaded(where, value, state, tmp_path):
    with pytest.raises(NotFiniteError, match=rf"^{where}\S* is not finite after 64 samples"):
        saved(broken(state, where, value), tmp_path, 64)
    assert list(tmp_path.iterdir()) == []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "not_finite", lambda arrays: [])
        path = saved(broken(state, where, value), tmp_path, 64)
    with pytest.raises(
        NotFiniteError,
        match=rf"{path.name}: {where}\S* is not finite: it can be neither continued nor evaluated",
    ):
        checkpoint.load(path, state)


def test_the_bookkeeping_of_episodes_may_be_nan(state, tmp_path):
    assert np.isnan(state.episodes.last_total).all()
    loaded = checkpoint.load(saved(broken(state, "episodes.env", np.nan), tmp_path, 0), state)
    assert np.isnan(loaded.episodes.last_total).all()


def test_the_configuration_is_in_the_file(state, tmp_path):
    assert checkpoint.config_of(saved(state, tmp_path, 0)) == SMALL
