"""Checkpoints: files of plain data; loading one runs no code.

A file is a line of JSON with schema and SHA-256, then Flax's msgpack of the arrays by name and the
configuration.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.serial import MAY_CHANGE, differences, from_dict, to_dict
from dgae_jax.learn.build import make_task, seed_keys
from dgae_jax.learn.parallel import make_trainer
from dgae_jax.learn.types import InferenceState, TrainState
from dgae_jax.run import files, runtime, terminal
from dgae_jax.run.metrics import EvaluationsFile

T = TypeVar("T")

SCHEMA, READABLE = 4, (3, 4)
"""Version of the file format that is written, and those that are read."""

RENAMED = r"^observations\b"
"""Names in schema 3 of what is `obs_stats` now."""

SCALE = "reward_scale.returns.std"
"""Name of the array that rewards are divided by."""


class CheckpointError(ConfigError):
    """A checkpoint that is missing, or of another run or version."""


class DamagedError(CheckpointError):
    """A checkpoint with other bytes than were written; an older one may be whole."""


class NotFiniteError(CheckpointError):
    """A state with a NaN or infinity that must not be saved, continued or evaluated."""


class Networks(NamedTuple):
    """Policies and critics of a checkpoint, with a leading axis of seeds."""

    policy: InferenceState
    critic: InferenceState
    path: Path


def arrays_of(tree: Any) -> dict[str, np.ndarray]:
    """Return a copy of the tree's arrays by name."""
    return {name: np.array(runtime.gather(x)) for name, x in sorted(_by_name(tree).items())}


def save(
    directory: Path,
    config: ResolvedConfig,
    arrays: dict[str, np.ndarray],
    steps: int,
    keep: int = 3,
    best: int | None = None,
) -> Path:
    """Write `steps_….msgpack` atomically, unless a number is not finite, and delete old ones.

    Keep the `keep` latest up to `steps`, and the best. Files later than `steps` were damaged, so
    the run resumed before them.
    """
    for name in not_finite(arrays):
        raise NotFiniteError(f"{name} is not finite after {steps:,} samples")
    path = directory / file_name(steps)
    write(path, config, arrays)
    for old in [p for p in checkpoints_in(directory) if p.name <= path.name][:-keep]:
        if best is None or old.name != file_name(best):
            old.unlink(missing_ok=True)
    return path


def write(path: Path, config: ResolvedConfig, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays by name and their configuration atomically."""
    parts = {"arrays": arrays, "config": json.dumps(to_dict(config), allow_nan=False)}
    body = flax.serialization.msgpack_serialize(parts)
    header = {"schema": SCHEMA, "sha256": hashlib.sha256(body).hexdigest()}
    files.replace(path, json.dumps(header).encode() + b"\n" + body)


def file_name(steps: int) -> str:
    """Return the name of the checkpoint after so many samples."""
    return f"steps_{steps:012d}.msgpack"


def checkpoints_in(directory: Path) -> list[Path]:
    """Return the checkpoints in a directory, oldest first."""
    return sorted(directory.glob(f"steps_{12 * '[0-9]'}.msgpack"))


def not_finite(arrays: dict[str, np.ndarray]) -> list[str]:
    """Return the names of arrays with a NaN or infinity where none may be.

    Networks, optimizers and running statistics must be finite. Envs (`episodes`) need not: the
    last return is NaN before the first, and an env may be kept for replay as it turned non-finite.
    """
    checked = (name for name in arrays if not name.startswith("episodes."))
    return [name for name in checked if not np.isfinite(arrays[name]).all()]


def read(path: Path) -> tuple[ResolvedConfig, dict[str, Any]]:
    """Return the configuration in a checkpoint or policy file, and its arrays by name.

    Raises:
        DamagedError: the file cannot be read whole.
        CheckpointError: it is of another version.
    """
    try:
        line, _, body = path.read_bytes().partition(b"\n")
        header = json.loads(line)
        if header["schema"] not in READABLE:
            raise CheckpointError(f"{path}: has schema {header['schema']}, must be 3 or {SCHEMA}")
        if hashlib.sha256(body).hexdigest() != header["sha256"]:
            raise DamagedError(f"{path}: is damaged (its checksum differs)")
        found: Any = flax.serialization.msgpack_restore(body)
        arrays = {re.sub(RENAMED, "obs_stats", name): x for name, x in found["arrays"].items()}
        settings = json.loads(found["config"])
    except CheckpointError:
        raise
    except OSError as reason:
        raise DamagedError(f"{path}: cannot be read ({reason.strerror})") from reason
    except Exception as reason:  # a hostile file makes the decoders raise many kinds
        raise DamagedError(f"{path}: is damaged ({type(reason).__name__})") from reason
    try:
        return resolve(from_dict(settings)), arrays
    except ConfigError as reason:
        raise CheckpointError(f"{path}: is of another version ({reason})") from reason


def load(path: Path, like: T, config: ResolvedConfig) -> T:
    """Return the arrays in a checkpoint or policy file, which may hold more, as a tree like `like`.

    Raises:
        CheckpointError: as `read`; or it is of another run than `config`, or lacks an array.
        NotFiniteError: there is a NaN or infinity where `not_finite` allows none.
    """
    written, arrays = read(path)
    for name, (here, there) in differences(config, written).items():
        if name not in MAY_CHANGE:  # the arrays may have the same shapes
            raise CheckpointError(f"{path}: is of another run, its {name} is {there}, here {here}")
    wanted = jax.eval_shape(_by_name, like)
    for name, x in wanted.items():
        found, here = arrays.get(name), f"{x.dtype}{x.shape}"
        there = f"{found.dtype}{found.shape}" if isinstance(found, np.ndarray) else "missing"
        if there != here:
            raise CheckpointError(f"{path}: is of another run, {name} is {there}, here {here}")
    for name in not_finite({name: arrays[name] for name in wanted}):
        raise NotFiniteError(f"{path}: {name} is not finite, so it cannot be used")

    def restored(at, like):
        leaf = jnp.asarray(arrays[_name(at)])
        return jax.random.wrap_key_data(leaf) if _is_key(like) else leaf

    return jax.tree.map_with_path(restored, like)


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _by_name(tree: Any) -> dict[str, Any]:
    """Return the tree's arrays by name; keys as the numbers they are made of."""
    named = ((_name(path), x) for path, x in jax.tree.leaves_with_path(tree))
    return {name: jax.random.key_data(x) if _is_key(x) else x for name, x in named}


def _name(path) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def latest_train_state(run_dir: Path, config: ResolvedConfig) -> tuple[TrainState, Path]:
    """Return the latest whole checkpoint and its file; raise CheckpointError if there is none."""
    like = _abstract_state(config)
    return next(_readable(run_dir, lambda path: (load(path, like, config), path)))


def load_networks(source: Path, config: ResolvedConfig, which: str) -> Networks:
    """Return the networks of a run directory or a policy file; nothing else in it is checked.

    Raises:
        ConfigError: the best is asked for and nothing was evaluated.
        CheckpointError: there is no whole checkpoint, or it is of another run than `config`.
    """
    if which not in ("latest", "best"):
        raise invalid("checkpoint", which, "one of latest, best")
    if source.is_file():
        return _load_networks(source, config)
    if which == "latest":
        return next(networks_in(source, config))
    steps = EvaluationsFile(source / "evaluations.jsonl").best
    if steps is None:
        raise invalid("checkpoint", which, f"latest: {source} has no evaluations")
    return _load_networks(source / "checkpoints" / file_name(steps), config)


def networks_in(run_dir: Path, config: ResolvedConfig) -> Iterator[Networks]:
    """Yield the networks of every checkpoint, latest first; raise as `latest_train_state`."""
    return _readable(run_dir, partial(_load_networks, config=config))


def reward_std(path: Path, config: ResolvedConfig) -> np.ndarray:
    """Return what rewards of each seed [S] are divided by; 1 without `normalize_rewards`.

    Raises:
        CheckpointError: as `load`; policy files once did not hold it.
    """
    if not config.normalize_rewards:
        return np.ones(config.num_seeds)
    like = {SCALE: _abstract_state(config).reward_scale.returns.std}
    return np.asarray(load(path, like, config)[SCALE])


def reset_episodes(state: TrainState, config: ResolvedConfig) -> TrainState:
    """Return the training state with every env at the start of an episode."""
    keys = jax.vmap(jax.random.fold_in)(seed_keys(config), state.iteration)
    task = make_task(config)  # lives until its envs have begun their episodes
    new = jax.block_until_ready(make_trainer(task, 1).init(config, keys).episodes)
    episodes = state.episodes._replace(env=new.env, steps=new.steps, total=new.total)
    scale = state.reward_scale._replace(discounted=jnp.zeros_like(state.reward_scale.discounted))
    return state._replace(episodes=episodes, reward_scale=scale)


def save_networks(path: Path, config: ResolvedConfig, networks: Networks, std: ArrayLike) -> None:
    """Write a policy file: networks and the scale of rewards, from `reward_std`."""
    (policy, stats), (critic, _), _ = networks
    parts = {"policy.params": policy, "critic.params": critic, "obs_stats": stats}
    scale = {SCALE: jnp.asarray(std, jnp.float32)} if config.normalize_rewards else {}
    write(path, config, arrays_of(parts | scale))


def _load_networks(path: Path, config: ResolvedConfig) -> Networks:
    policy, critic, stats, *_ = _abstract_state(config)
    like = {"policy.params": policy.params, "critic.params": critic.params, "obs_stats": stats}
    policy, critic, stats = map(load(path, like, config).get, like)
    return Networks(InferenceState(policy, stats), InferenceState(critic, stats), path)


def _abstract_state(config: ResolvedConfig) -> TrainState:
    """Return shapes and dtypes of a training state."""
    return jax.eval_shape(make_trainer(make_task(config), 1).init, config, seed_keys(config))


def _readable(run_dir: Path, read: Callable[[Path], T]) -> Iterator[T]:
    """Read the checkpoints, latest first; warn of damaged ones, and refuse if there is no other."""
    found = False
    for path in reversed(checkpoints_in(run_dir / "checkpoints")):
        try:
            result = read(path)
        except DamagedError as reason:
            terminal.warn(f"warning: {reason}; skipped")
            continue
        found = True
        yield result
    if not found:
        raise CheckpointError(f"{run_dir}: must hold a whole checkpoint; checkpoints/ has none")
