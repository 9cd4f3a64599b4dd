"""The whole training state in one file of plain data (msgpack): loading it runs no code."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import serialization

from dgae_jax.build import make_task, make_trainer, seed_keys
from dgae_jax.config import Config
from dgae_jax.types import TrainState


class CheckpointError(ValueError):
    """A checkpoint that is missing, damaged or of another run; the message names the file and the reason."""


def save(directory: Path, state: TrainState, steps: int, keep: int = 3) -> Path:
    """Write `steps_….msgpack`, complete or not at all, and delete all but the newest `keep`."""
    path = directory / f"steps_{steps:012d}.msgpack"
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        file.write(serialization.msgpack_serialize(jax.tree.map(np.asarray, _plain(state))))
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    for old in sorted(directory.glob("steps_*.msgpack"))[:-keep]:
        old.unlink()
    return path


def latest(run_dir: Path) -> Path:
    """The newest checkpoint of a run; raises CheckpointError if there is none."""
    found = sorted((run_dir / "checkpoints").glob("steps_*.msgpack"))
    if not found:
        raise CheckpointError(f"{run_dir}: must hold a checkpoint; checkpoints/ has none")
    return found[-1]


def load(path: Path, config: Config) -> TrainState:
    """The state saved at `path` by a run of `config`; raises CheckpointError if it is damaged or does not fit."""
    blank = jax.eval_shape(make_trainer(make_task(config), 1).init, config, seed_keys(config))
    want = jax.eval_shape(_plain, blank)
    try:
        got = serialization.msgpack_restore(path.read_bytes())
        names = set(map(str, got.keys()))
    except OSError as reason:
        raise CheckpointError(f"{path}: cannot be read ({reason.strerror})") from reason
    except Exception as reason:  # the decoder raises many kinds for damaged bytes
        raise CheckpointError(f"{path}: is damaged ({type(reason).__name__})") from reason
    for name in sorted(names ^ set(want)):
        raise CheckpointError(f"{path}: is of another run, {name} is {'unknown here' if name in names else 'missing'}")
    for name, like in want.items():
        if np.shape(got[name]) != like.shape or np.asarray(got[name]).dtype != like.dtype:
            raise CheckpointError(f"{path}: is of another run, {name} is {np.shape(got[name])}, here {like.shape}")

    def restored(path, like):
        leaf = jnp.asarray(got[_name(path)])
        return jax.random.wrap_key_data(leaf) if _is_key(like) else leaf

    return jax.tree.map_with_path(restored, blank)


def _is_key(x) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _plain(state: TrainState) -> dict[str, jax.Array]:
    """The state's arrays by name; keys as the numbers they are made of."""
    return {_name(path): jax.random.key_data(x) if _is_key(x) else x for path, x in jax.tree.leaves_with_path(state)}


def _name(path) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")
