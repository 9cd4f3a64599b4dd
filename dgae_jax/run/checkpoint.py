"""Checkpoints: files of plain data; loading one runs no code.

A file is a line of JSON with schema and SHA-256, then msgpack with the arrays by name and the
configuration.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import msgpack
import numpy as np
from jaxtyping import ArrayLike

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.serial import MAY_CHANGE, differences, from_dict, to_dict
from dgae_jax.learn.build import make_task, make_trainer, seed_keys
from dgae_jax.learn.types import InferenceState, TrainState
from dgae_jax.run import files, runtime, terminal
from dgae_jax.run.metrics import EvaluationsFile

T = TypeVar("T")

SCHEMA = 4
"""Version of the file format."""

RENAMED = {3: {"observations": "obs_stats"}}
"""By schema: the old first part of an array's name, and the one in the next schema."""

UNREADABLE = {
    1: "what it calls physics mjx is now called jax",
    2: "its envs drew random numbers in another way",
}
"""Schemas that are refused, and why."""

ARRAY = 1
"""Msgpack's extension type of an array: shape, name of the dtype and bytes, as Flax writes it."""

MAX_ARRAYS = 10_000
"""Most arrays in a file; containers that are larger are refused before they take memory."""

WHICH = ("latest", "best")
"""Choices of a checkpoint: the latest whole one, or that of the best evaluation."""


class CheckpointError(ConfigError):
    """A checkpoint that is missing, or of another run or version."""


class DamagedError(CheckpointError):
    """A checkpoint with other bytes than were written; an older one may be whole."""


class MissingError(CheckpointError):
    """A checkpoint without an array that is looked for."""


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
    """Write `steps_….msgpack` atomically and delete old checkpoints.

    Args:
        directory: where the checkpoints are.
        config: the run.
        arrays: the training state, from `arrays_of`.
        steps: samples of each run so far. Files of more steps do not count: the run went back
            behind them because they were damaged.
        keep: how many of the latest files stay.
        best: steps of the best evaluation; its file stays too.

    Raises:
        NotFiniteError: a number is not finite; nothing is written.
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

    def pack(value: Any) -> bytes:
        return msgpack.packb(value)  # pyright: ignore[reportReturnType]

    packed = {
        name: msgpack.ExtType(ARRAY, pack((x.shape, x.dtype.name, x.tobytes())))
        for name, x in arrays.items()
    }
    body = pack({"arrays": packed, "config": json.dumps(to_dict(config), allow_nan=False)})
    header = {"schema": SCHEMA, "sha256": hashlib.sha256(body).hexdigest()}
    files.replace(path, json.dumps(header, allow_nan=False).encode() + b"\n" + body)


def file_name(steps: int) -> str:
    """Return the name of the checkpoint after so many samples."""
    return f"steps_{steps:012d}.msgpack"


def checkpoints_in(directory: Path) -> list[Path]:
    """Return the checkpoints in a directory, oldest first; no link is followed."""
    named = (p for p in directory.glob("*") if re.fullmatch(r"steps_\d{12}\.msgpack", p.name))
    return sorted(p for p in named if p.is_file() and not p.is_symlink())


def not_finite(arrays: dict[str, np.ndarray]) -> list[str]:
    """Return the names of arrays with a NaN or infinity where none may be.

    Networks, optimizers and running statistics must be finite. Envs (`episodes`) need not: the
    last return is NaN before the first, and an env may be kept for replay as it turned non-finite.
    """

    def must_be_finite(name: str, x: np.ndarray) -> bool:
        return jnp.issubdtype(x.dtype, jnp.inexact) and not name.startswith("episodes.")

    checked = (name for name, x in arrays.items() if must_be_finite(name, x))
    return [name for name in checked if not np.isfinite(arrays[name]).all()]


def config_of(path: Path) -> ResolvedConfig:
    """Return the configuration in a checkpoint; raises as `load`."""
    _, _, text = _read(path)
    try:
        return resolve(from_dict(json.loads(text)))
    except ConfigError as reason:
        raise CheckpointError(f"{path}: is of another version ({reason})") from reason
    except (ValueError, TypeError, RecursionError) as reason:
        raise DamagedError(f"{path}: is damaged (no configuration)") from reason


def load(path: Path, like: T, *, part: bool = False) -> T:
    """Return the tree of arrays saved at `path`.

    Args:
        path: a checkpoint or policy file.
        like: the same tree of anything with shape and dtype, which the arrays must have.
        part: the file may hold more than `like`.

    Raises:
        DamagedError: the file cannot be read whole.
        MissingError: an array is missing.
        CheckpointError: an array is unknown, or of another type or shape.
        NotFiniteError: there is a NaN or infinity where `not_finite` allows none.
    """
    want = jax.eval_shape(_by_name, like)
    schema, packed, _ = _read(path)
    got = {}
    for old_name, value in packed.items():
        name = _current_name(old_name, schema)
        if name in want:
            got[name] = _array(path, name, value, want[name])
        elif not part:
            raise CheckpointError(f"{path}: is of another run, {name[:200]} is unknown here")
    for name in sorted(set(want) - set(got)):
        raise MissingError(f"{path}: is of another run, {name} is missing")
    for name in not_finite(got):
        raise NotFiniteError(f"{path}: {name} is not finite, so it cannot be used")

    def restored(at, like):
        leaf = jnp.asarray(got[_name(at)])
        return jax.random.wrap_key_data(leaf) if _is_key(like) else leaf

    return jax.tree.map_with_path(restored, like)


def _read(path: Path) -> tuple[int, dict[str, Any], str]:
    """Check the checksum and return schema, packed arrays and configuration."""
    try:
        data = path.read_bytes()
    except OSError as reason:
        raise DamagedError(f"{path}: cannot be read ({reason.strerror})") from reason
    end = data.find(b"\n")
    schema, checksum = _header(path, data[: max(end, 0)])
    body = memoryview(data)[end + 1 :]
    if hashlib.sha256(body).hexdigest() != checksum:
        raise DamagedError(f"{path}: is damaged (its checksum differs)")
    with _decoding(path):
        found: Any = msgpack.unpackb(body, max_array_len=0, max_map_len=MAX_ARRAYS)
        if list(found) != ["arrays", "config"] or not all(type(x) is str for x in found["arrays"]):
            raise ValueError
        return schema, found["arrays"], found["config"]


def _header(path: Path, line: bytes) -> tuple[int, str]:
    try:
        header = json.loads(line)
        schema, checksum = header["schema"], header["sha256"]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise DamagedError(f"{path}: is damaged (no header)") from None
    if type(schema) is not int:
        raise DamagedError(f"{path}: is damaged (no schema)")
    if schema not in (*RENAMED, SCHEMA):
        why = UNREADABLE.get(schema, "it is of a newer version")
        raise CheckpointError(f"{path}: has schema {schema}, must be at most {SCHEMA}: {why}")
    return schema, checksum


def _current_name(name: str, schema: int) -> str:
    first, dot, rest = name.partition(".")
    for version in range(schema, SCHEMA):
        first = RENAMED[version].get(first, first)
    return first + dot + rest


def _array(path: Path, name: str, packed: Any, like: Any) -> np.ndarray:
    """Decode an array; its type and shape are compared before its bytes become numbers."""
    with _decoding(path):
        if packed.code != ARRAY:
            raise ValueError
        shape, dtype, data = msgpack.unpackb(packed.data, max_array_len=32, max_map_len=0)
        if not all(type(n) is int for n in shape) or not isinstance(dtype, str):
            raise ValueError
    if (tuple(shape), dtype) != (like.shape, like.dtype.name):
        found, here = f"{dtype[:20]}{tuple(shape)}", f"{like.dtype}{like.shape}"
        raise CheckpointError(f"{path}: is of another run, {name} is {found}, here {here}")
    with _decoding(path):
        return np.frombuffer(data, like.dtype).reshape(like.shape)


@contextmanager
def _decoding(path: Path) -> Iterator[None]:
    """Refuse a file that cannot be decoded; a hostile one makes the decoder raise many kinds."""
    try:
        yield
    except Exception as reason:
        raise DamagedError(f"{path}: is damaged ({type(reason).__name__})") from reason


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _by_name(tree: Any) -> dict[str, Any]:
    """Return the tree's arrays by name; keys as the numbers they are made of."""
    named = ((_name(path), x) for path, x in jax.tree.leaves_with_path(tree))
    return {name: jax.random.key_data(x) if _is_key(x) else x for name, x in named}


def _name(path) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def latest_train_state(run_dir: Path, config: ResolvedConfig) -> tuple[TrainState, Path]:
    """Return the latest whole checkpoint and its file; warn of damaged ones.

    Raises:
        CheckpointError: there is none, or it is of another run than `config`.
    """
    return _latest(run_dir, partial(load_train_state, config=config))


def load_train_state(path: Path, config: ResolvedConfig) -> TrainState:
    """Return the training state in one file; raises as `load`."""
    _check_run(path, config)
    state = load(path, _abstract_state(config))
    for iteration in state.iteration:
        if path.name != file_name(int(iteration) * config.samples_per_iteration):
            raise CheckpointError(f"{path}: is renamed, it was saved after {iteration} iterations")
    return state


def load_networks(source: Path, config: ResolvedConfig, which: str) -> Networks:
    """Return the networks of a run directory or a policy file; nothing else in it is read.

    Raises:
        ConfigError: the best is asked for and nothing was evaluated.
        CheckpointError: as `latest_train_state`.
    """
    if which not in WHICH:
        raise invalid("checkpoint", which, f"one of {', '.join(WHICH)}")
    if source.is_file():
        if which != "latest":
            raise invalid("checkpoint", which, f"latest: {source} is a single one")
        return _load_networks(source, config)
    if which == "latest":
        return _latest(source, partial(_load_networks, config=config))[0]
    steps = EvaluationsFile(source / "evaluations.jsonl").best
    if steps is None:
        raise invalid("checkpoint", which, f"latest: {source} has no evaluations")
    return _load_networks(source / "checkpoints" / file_name(steps), config)


def load_all_networks(run_dir: Path, config: ResolvedConfig) -> Iterator[Networks]:
    """Yield the networks of every checkpoint, oldest first; warn of damaged ones.

    Raises:
        CheckpointError: there is none, or one is of another run than `config`.
    """
    for path in _some(run_dir):
        try:
            yield _load_networks(path, config)
        except DamagedError as reason:
            terminal.warn(f"warning: {reason}; skipped")


def reward_std(path: Path, config: ResolvedConfig) -> np.ndarray:
    """Return what rewards of each seed [S] are divided by; 1 without `normalize_rewards`.

    Raises:
        CheckpointError: the file does not say, as policy files once did not.
    """
    if not config.normalize_rewards:
        return np.ones(config.num_seeds)
    part = _scale(_abstract_state(config).reward_scale.returns.std)
    try:
        return np.asarray(load(path, part, part=True)["reward_scale"]["returns"]["std"])
    except MissingError:
        hint = "dgae refit fits a critic that does"
        raise CheckpointError(f"{path}: lacks the scale of rewards; {hint}") from None


def reset_episodes(state: TrainState, config: ResolvedConfig) -> TrainState:
    """Return the training state with every env at the start of an episode."""
    keys = jax.vmap(jax.random.fold_in)(seed_keys(config), state.iteration)
    new = make_trainer(make_task(config), 1).init(config, keys).episodes
    episodes = state.episodes._replace(env=new.env, steps=new.steps, total=new.total)
    scale = state.reward_scale._replace(discounted=jnp.zeros_like(state.reward_scale.discounted))
    return state._replace(episodes=episodes, reward_scale=scale)


def save_networks(path: Path, config: ResolvedConfig, networks: Networks, std: ArrayLike) -> None:
    """Write a policy file: networks and the scale of rewards, from `reward_std`."""
    policy, critic, _ = networks
    scale = _scale(jnp.asarray(std, jnp.float32)) if config.normalize_rewards else {}
    parts = _networks(policy.params, critic.params, policy.obs_stats)
    write(path, config, arrays_of(parts | scale))


def _networks(policy: Any, critic: Any, obs_stats: Any) -> dict[str, Any]:
    """Name the parts as a training state does."""
    networks = {"policy": {"params": policy}, "critic": {"params": critic}}
    return networks | {"obs_stats": obs_stats}


def _scale(std: Any) -> dict[str, Any]:
    return {"reward_scale": {"returns": {"std": std}}}


def _load_networks(path: Path, config: ResolvedConfig) -> Networks:
    _check_run(path, config)
    state: Any = _abstract_state(config)
    part = _networks(state.policy.params, state.critic.params, state.obs_stats)
    got = load(path, part, part=True)
    policy = InferenceState(got["policy"]["params"], got["obs_stats"])
    return Networks(policy, InferenceState(got["critic"]["params"], got["obs_stats"]), path)


def _check_run(path: Path, config: ResolvedConfig) -> None:
    """Refuse a checkpoint of another run; its arrays may have the same shapes."""
    for name, (ours, theirs) in differences(config, config_of(path)).items():
        if name not in MAY_CHANGE:
            raise CheckpointError(f"{path}: is of another run, its {name} is {theirs}, here {ours}")


def _abstract_state(config: ResolvedConfig) -> TrainState:
    """Return shapes and dtypes of a training state."""
    return jax.eval_shape(make_trainer(make_task(config), 1).init, config, seed_keys(config))


def _latest(run_dir: Path, read: Callable[[Path], T]) -> tuple[T, Path]:
    damaged = []
    for path in reversed(_some(run_dir)):
        try:
            result = read(path)
        except DamagedError as reason:
            damaged.append(str(reason))
            continue
        for each in damaged:
            terminal.warn(f"warning: {each}; falling back to {path.name}")
        return result, path
    raise CheckpointError("; ".join(damaged))


def _some(run_dir: Path) -> list[Path]:
    if paths := checkpoints_in(run_dir / "checkpoints"):
        return paths
    raise CheckpointError(f"{run_dir}: must hold a checkpoint; checkpoints/ has none")
