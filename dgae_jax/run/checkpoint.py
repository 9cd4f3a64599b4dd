"""The whole training state in one file of plain data (msgpack): loading it runs no code."""

import hashlib
import json
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import serialization

from dgae_jax.configs.build import make_task, make_trainer, seed_keys
from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.configs.serial import MAY_CHANGE, differences, from_dict, to_dict
from dgae_jax.learn.types import TrainState
from dgae_jax.run import files

SCHEMA = 1
"""Version of the file format."""


class CheckpointError(ValueError):
    """A checkpoint that is missing or of another run or version; the message names the file and the reason."""


class DamagedError(CheckpointError):
    """A checkpoint whose bytes are not what was written; an older one may be whole."""


def arrays_of(state: TrainState) -> dict[str, np.ndarray]:
    """A copy of the state's arrays by name."""
    return {name: np.array(x) for name, x in _plain(state).items()}


def save(directory: Path, config: Config, arrays: dict[str, np.ndarray], steps: int, keep: int = 3, best: int | None = None) -> Path:
    """Write `steps_….msgpack`, complete or not at all, and delete all but the newest `keep` and that of `best` steps.

    Files of more steps do not count: the run went back behind them because they were damaged. The file is one line of JSON, with
    schema and checksum, and the configuration and the arrays in msgpack.
    """
    path = directory / _name_of(steps)
    body = serialization.msgpack_serialize({"config": json.dumps(to_dict(config)), "arrays": arrays})
    header = {"schema": SCHEMA, "sha256": hashlib.sha256(body).hexdigest()}
    files.replace(path, json.dumps(header).encode() + b"\n" + body)
    for old in [p for p in found(directory) if p.name <= path.name][:-keep]:
        if best is None or old.name != _name_of(best):
            old.unlink(missing_ok=True)
    return path


def _name_of(steps: int) -> str:
    return f"steps_{steps:012d}.msgpack"


def found(directory: Path) -> list[Path]:
    """The checkpoints in a directory, oldest first; no link is followed."""
    named = (p for p in directory.glob("steps_*.msgpack") if re.fullmatch(r"steps_\d{12}\.msgpack", p.name))
    return sorted(p for p in named if p.is_file() and not p.is_symlink())


def newest(run_dir: Path, config: Config) -> tuple[TrainState, Path]:
    """The state of the newest checkpoint that is whole, and its file; warns of damaged ones.

    Raises CheckpointError if there is none.
    """
    wrong = []
    for path in reversed(found(run_dir / "checkpoints")):
        try:
            state = load(path, config)
        except DamagedError as reason:
            wrong.append(str(reason))
            continue
        for each in wrong:
            print(f"warning: {each}; falling back to {path.name}", file=sys.stderr)
        return state, path
    raise CheckpointError("; ".join(wrong) or f"{run_dir}: must hold a checkpoint; checkpoints/ has none")


def at(run_dir: Path, steps: int, config: Config) -> tuple[TrainState, Path]:
    """The state after `steps` samples and its file; raises as `load`."""
    path = run_dir / "checkpoints" / _name_of(steps)
    return load(path, config), path


def load(path: Path, config: Config) -> TrainState:
    """The state saved at `path` by a run of `config`.

    Raises DamagedError if the file cannot be read whole, CheckpointError if it is of another run or a newer version.
    """
    saved, got = _read(path)
    for name, (ours, theirs) in differences(config, saved).items():
        if name not in MAY_CHANGE:
            raise CheckpointError(f"{path}: is of another run, its {name} is {theirs}, here {ours}")
    blank = jax.eval_shape(make_trainer(make_task(config), 1).init, config, seed_keys(config))
    want = jax.eval_shape(_plain, blank)
    for name in sorted(set(got) ^ set(want)):
        raise CheckpointError(f"{path}: is of another run, {name} is {'unknown here' if name in got else 'missing'}")
    for name, like in want.items():
        kind = f"{got[name].dtype}{got[name].shape}"
        if kind != f"{like.dtype}{like.shape}":
            raise CheckpointError(f"{path}: is of another run, {name} is {kind}, here {like.dtype}{like.shape}")
    for iteration in got["iteration"]:
        if path.name != _name_of(int(iteration) * config.samples_per_iteration):
            raise CheckpointError(f"{path}: is renamed, it was saved after {iteration} iterations")

    def restored(path, like):
        leaf = jnp.asarray(got[_name(path)])
        return jax.random.wrap_key_data(leaf) if _is_key(like) else leaf

    return jax.tree.map_with_path(restored, blank)


def _read(path: Path) -> tuple[Config, dict[str, np.ndarray]]:
    """Configuration, and arrays by name. Nothing in the file is ever run, and only bytes that match their checksum are decoded."""
    try:
        first, _, body = path.read_bytes().partition(b"\n")
    except OSError as reason:
        raise DamagedError(f"{path}: cannot be read ({reason.strerror})") from reason
    try:
        header = json.loads(first)
        schema, checksum = header["schema"], header["sha256"]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise DamagedError(f"{path}: is damaged (no header)") from None
    if type(schema) is not int:
        raise DamagedError(f"{path}: is damaged (no schema)")
    if schema != SCHEMA:
        raise CheckpointError(f"{path}: has schema {schema}; this version reads schema {SCHEMA}")
    if hashlib.sha256(body).hexdigest() != checksum:
        raise DamagedError(f"{path}: is damaged (its checksum differs)")
    try:
        parts = serialization.msgpack_restore(body)
        arrays = {str(name): np.asarray(array) for name, array in parts["arrays"].items()}
        return from_dict(json.loads(str(parts["config"]))), arrays
    except ConfigError as reason:
        raise CheckpointError(f"{path}: is of another version ({reason})") from reason
    except Exception as reason:  # a hostile file may carry a valid checksum; the decoder raises many kinds
        raise DamagedError(f"{path}: is damaged ({type(reason).__name__})") from reason


def _is_key(x) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _plain(state: TrainState) -> dict[str, jax.Array]:
    """The state's arrays by name; keys as the numbers they are made of."""
    return {_name(path): jax.random.key_data(x) if _is_key(x) else x for path, x in jax.tree.leaves_with_path(state)}


def _name(path) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")
