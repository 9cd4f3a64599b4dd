"""One file of plain data (msgpack) per checkpoint: loading it runs no code, and takes no more memory than what is expected of it.

A file is one line of JSON with schema and checksum, and then, in msgpack, the arrays by name and the configuration. What the
arrays should be, a tree of shapes, and whether the configuration fits is for the caller to say.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

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
"""Version of the file format. In 1 the physics `jax` was called `mjx`; up to 2 all envs drew from
one key."""

RENAMED = {3: {"observations": "obs_stats"}}
"""By schema: the old first part of an array's name, and the one in the next schema."""

ARRAY = 1
"""Msgpack's extension type of an array: shape, name of the dtype and bytes, as Flax writes it."""


class CheckpointError(ConfigError):
    """A checkpoint that is missing or of another run or version; the message names the file and the reason."""


class DamagedError(CheckpointError):
    """A checkpoint whose bytes are not what was written; an older one may be whole."""


class MissingError(CheckpointError):
    """A file without an array that is looked for."""


class NotFiniteError(CheckpointError):
    """A state that must not be saved, continued or evaluated: a number in it is NaN or infinite."""


def arrays_of(tree: Any) -> dict[str, np.ndarray]:
    """A copy of the tree's arrays by name, as `save` takes them."""
    return {name: np.array(runtime.gather(x)) for name, x in sorted(_plain(tree).items())}


def save(
    directory: Path,
    config: ResolvedConfig,
    arrays: dict[str, np.ndarray],
    steps: int,
    keep: int = 3,
    best: int | None = None,
) -> Path:
    """Write `steps_….msgpack`, complete or not at all, and delete all but the latest `keep` and that of `best` steps.

    Files of more steps do not count: the run went back behind them because they were damaged. Raises NotFiniteError, and
    writes nothing, if a number is not finite.
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
    """Arrays by name and the configuration that they belong to as one file, complete or not at all."""
    packed = {name: _packed(x) for name, x in arrays.items()}
    body: bytes = msgpack.packb(
        {"arrays": packed, "config": json.dumps(to_dict(config), allow_nan=False)}
    )  # pyright: ignore[reportAssignmentType]
    header = {"schema": SCHEMA, "sha256": hashlib.sha256(body).hexdigest()}
    files.replace(path, json.dumps(header, allow_nan=False).encode() + b"\n" + body)


def _packed(x: np.ndarray) -> msgpack.ExtType:
    return msgpack.ExtType(ARRAY, msgpack.packb((x.shape, x.dtype.name, x.tobytes())))  # pyright: ignore[reportArgumentType]


def file_name(steps: int) -> str:
    """The file of the state after so many samples."""
    return f"steps_{steps:012d}.msgpack"


def checkpoints_in(directory: Path) -> list[Path]:
    """The checkpoints in a directory, oldest first; no link is followed."""
    named = (
        p
        for p in directory.glob("steps_*.msgpack")
        if re.fullmatch(r"steps_\d{12}\.msgpack", p.name)
    )
    return sorted(p for p in named if p.is_file() and not p.is_symlink())


def not_finite(arrays: dict[str, np.ndarray]) -> list[str]:
    """Names of arrays with a number that is NaN or infinite where it must not be.

    Networks, optimisers and running statistics must be finite. Worlds (`episodes`) need not: the return of the last episode
    is NaN before the first, and a world may be kept for replay as it turned non-finite.
    """
    learnt = (
        name
        for name, x in arrays.items()
        if jnp.issubdtype(x.dtype, jnp.inexact) and not name.startswith("episodes.")
    )
    return [name for name in learnt if not np.isfinite(arrays[name]).all()]


def config_of(path: Path) -> ResolvedConfig:
    """The configuration in a checkpoint; raises as `load`."""
    with _body(path) as (file, size, _), _decoding(path):
        unpacker = msgpack.Unpacker(file, max_buffer_size=size)
        if (unpacker.read_map_header(), unpacker.unpack()) != (2, "arrays"):
            raise ValueError
        unpacker.skip()
        if unpacker.unpack() != "config":
            raise ValueError
        text = unpacker.unpack()
    try:
        return resolve(from_dict(json.loads(text)))
    except ConfigError as reason:
        raise CheckpointError(f"{path}: is of another version ({reason})") from reason
    except (ValueError, TypeError, RecursionError) as reason:
        raise DamagedError(f"{path}: is damaged (no configuration)") from reason


def load(path: Path, like: T, *, part: bool = False) -> T:
    """The tree of arrays saved at `path`, in which each is as `like` says (anything with shape and dtype).

    With `part` the file may hold more than `like`. Raises DamagedError if the file cannot be read whole, MissingError if an array is
    missing, CheckpointError if one is unknown or of another type or shape, which is seen before it is decoded, NotFiniteError if it
    holds NaN or infinity where `not_finite` says that it must not.
    """
    want = jax.eval_shape(_plain, like)
    with _body(path) as (file, size, schema):
        got = dict(_arrays(path, file, size, schema, want, part))
    for name in sorted(set(want) - set(got)):
        raise MissingError(f"{path}: is of another run, {name} is missing")
    for name in not_finite(got):
        raise NotFiniteError(
            f"{path}: {name} is not finite: it can be neither continued nor evaluated"
        )

    def restored(at, like):
        leaf = jnp.asarray(got[_name(at)])
        return jax.random.wrap_key_data(leaf) if _is_key(like) else leaf

    return jax.tree.map_with_path(restored, like)


def _arrays(
    path: Path, file: BinaryIO, size: int, schema: int, want: dict[str, Any], part: bool
) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays by name. Containers and whatever is not expected are refused before they take memory."""
    with _decoding(path):
        unpacker = msgpack.Unpacker(file, max_buffer_size=size, max_array_len=0, max_map_len=0)
        if (unpacker.read_map_header(), unpacker.unpack()) != (2, "arrays"):
            raise ValueError
        count = unpacker.read_map_header()
    for _ in range(count):
        with _decoding(path):
            name = unpacker.unpack()
            if not isinstance(name, str):
                raise ValueError
            name = _upgraded(name, schema)
            if name not in want and part:
                unpacker.skip()
                continue
        if name not in want:
            raise CheckpointError(f"{path}: is of another run, {name[:200]} is unknown here")
        with _decoding(path):
            packed = unpacker.unpack()
            if not isinstance(packed, msgpack.ExtType) or packed.code != ARRAY:
                raise ValueError
        yield name, _array(path, name, packed.data, want[name])


def _array(path: Path, name: str, packed: bytes, like: Any) -> np.ndarray:
    """One array, whose type and shape are compared before its bytes become numbers."""
    with _decoding(path):
        unpacker = msgpack.Unpacker(max_buffer_size=len(packed), max_array_len=0, max_map_len=0)
        unpacker.feed(packed)
        if unpacker.read_array_header() != 3 or (axes := unpacker.read_array_header()) > 32:
            raise ValueError
        shape, dtype = tuple(unpacker.unpack() for _ in range(axes)), unpacker.unpack()
        if not all(type(n) is int for n in shape) or not isinstance(dtype, str):
            raise ValueError
    if (shape, dtype) != (like.shape, like.dtype.name):
        raise CheckpointError(
            f"{path}: is of another run, {name} is {dtype[:20]}{shape}, here {like.dtype}{like.shape}"
        )
    with _decoding(path):
        return np.frombuffer(unpacker.unpack(), like.dtype).reshape(like.shape)


@contextmanager
def _body(path: Path) -> Iterator[tuple[BinaryIO, int, int]]:
    """Check the header and the checksum; the file behind the header, its size and its schema."""
    try:
        with path.open("rb") as file:
            schema, checksum = _header(path, file.readline(4096))
            start = file.tell()
            if hashlib.file_digest(file, "sha256").hexdigest() != checksum:  # pyright: ignore[reportArgumentType]
                raise DamagedError(f"{path}: is damaged (its checksum differs)")
            size = file.tell()
            file.seek(start)
            yield file, size, schema
    except OSError as reason:
        raise DamagedError(f"{path}: cannot be read ({reason.strerror})") from reason


def _upgraded(name: str, schema: int) -> str:
    """Return today's name of an array."""
    first, dot, rest = name.partition(".")
    for version in range(schema, SCHEMA):
        first = RENAMED[version].get(first, first)
    return first + dot + rest


def _header(path: Path, line: bytes) -> tuple[int, str]:
    """Return the schema and the checksum."""
    try:
        header = json.loads(line)
        schema, checksum = header["schema"], header["sha256"]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise DamagedError(f"{path}: is damaged (no header)") from None
    if type(schema) is not int:
        raise DamagedError(f"{path}: is damaged (no schema)")
    if schema < min(RENAMED):
        why = (
            "what it calls physics mjx is now called jax"
            if schema < 2
            else "its worlds drew random numbers in another way"
        )
        way = "continue it with the version that wrote it, or train again"
        raise CheckpointError(
            f"{path}: has schema {schema}, this version reads schema {SCHEMA}: {why}; {way}"
        )
    if schema > SCHEMA:
        raise CheckpointError(
            f"{path}: has schema {schema}, of a newer version; this version reads schema {SCHEMA}"
        )
    return schema, checksum


@contextmanager
def _decoding(path: Path) -> Iterator[None]:
    """A hostile file may carry a valid checksum, and the decoder raises many kinds."""
    try:
        yield
    except OSError:
        raise
    except Exception as reason:
        raise DamagedError(f"{path}: is damaged ({type(reason).__name__})") from reason


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _plain(tree: Any) -> dict[str, Any]:
    """The tree's arrays by name; keys as the numbers they are made of."""
    return {
        _name(path): jax.random.key_data(x) if _is_key(x) else x
        for path, x in jax.tree.leaves_with_path(tree)
    }


def _name(path) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


T = TypeVar("T")

WHICH = ("latest", "best")
"""Which checkpoint: the latest whole one, or that of the best evaluation."""


class Networks(NamedTuple):
    """Policy and critic of every run in a checkpoint, with a leading axis of runs, and its file."""

    policy: InferenceState
    critic: InferenceState
    path: Path


def latest_train_state(run_dir: Path, config: ResolvedConfig) -> tuple[TrainState, Path]:
    """All of the latest checkpoint that is whole, and its file; warns of damaged ones.

    Raises CheckpointError if there is none, or it is of another run than `config`.
    """
    return _latest(run_dir, partial(load_train_state, config=config))


def load_networks(source: Path, config: ResolvedConfig, which: str) -> Networks:
    """The networks of a run directory's latest checkpoint or its best, or of a file; nothing else in the file is looked at.

    Raises ConfigError if the best is asked for and nothing was evaluated, CheckpointError as `training_state`.
    """
    if which not in WHICH:
        raise invalid("checkpoint", which, f"one of {', '.join(WHICH)}")
    if source.is_file():
        if which != "latest":
            raise invalid("checkpoint", which, f"latest: {source} is a single one")
        return _load_networks(source, config)
    run_dir = source
    if which == "latest":
        return _latest(run_dir, partial(_load_networks, config=config))[0]
    steps = EvaluationsFile(run_dir / "evaluations.jsonl").best
    if steps is None:
        raise invalid("checkpoint", which, f"latest: {run_dir} has no evaluations")
    return _load_networks(run_dir / "checkpoints" / file_name(steps), config)


def load_all_networks(run_dir: Path, config: ResolvedConfig) -> Iterator[Networks]:
    """The networks of every checkpoint that a run keeps, oldest first; warns of damaged ones and leaves them out.

    Raises CheckpointError if there is none, or one is of another run than `config`.
    """
    paths = checkpoints_in(run_dir / "checkpoints")
    if not paths:
        raise _none(run_dir)
    for path in paths:
        try:
            yield _load_networks(path, config)
        except DamagedError as reason:
            terminal.warn(f"warning: {reason}; left out")


def reward_std(path: Path, config: ResolvedConfig) -> np.ndarray:
    """What the rewards of every run [S] were last divided by in the checkpoint at `path`; 1 without `normalize_rewards`.

    Raises CheckpointError for a file that does not say, as those of policies once did not.
    """
    if not config.normalize_rewards:
        return np.ones(config.num_seeds)
    part = _scale(_blank(config).reward_scale.returns.std)
    try:
        return np.asarray(load(path, part, part=True)["reward_scale"]["returns"]["std"])
    except MissingError:
        raise CheckpointError(
            f"{path}: does not say what rewards were divided by; dgae refit fits a critic that does"
        ) from None


def load_train_state(path: Path, config: ResolvedConfig) -> TrainState:
    """The training state in one file; raises as `checkpoint.load`, and CheckpointError if the file is not of this run."""
    _compare(path, config)
    state = load(path, _blank(config))
    for iteration in state.iteration:
        if path.name != file_name(int(iteration) * config.samples_per_iteration):
            raise CheckpointError(f"{path}: is renamed, it was saved after {iteration} iterations")
    return state


def reset_episodes(state: TrainState, config: ResolvedConfig) -> TrainState:
    """The training state with every world at the beginning of an episode, as it is after no other number of iterations."""
    keys = jax.vmap(jax.random.fold_in)(seed_keys(config), state.iteration)
    new = make_trainer(make_task(config), 1).init(config, keys).episodes
    episodes = state.episodes._replace(env=new.env, steps=new.steps, total=new.total)
    scale = state.reward_scale._replace(discounted=jnp.zeros_like(state.reward_scale.discounted))
    return state._replace(episodes=episodes, reward_scale=scale)


def save_networks(path: Path, config: ResolvedConfig, networks: Networks, std: ArrayLike) -> None:
    """What acting and predicting takes as a file of its own, which `trained` and `reward_std` read; `std` as from the latter."""
    (policy, critic), stats = (networks.policy, networks.critic), networks.policy.obs_stats
    scale = _scale(jnp.asarray(std, jnp.float32)) if config.normalize_rewards else {}
    write(path, config, arrays_of(_networks(policy.params, critic.params, stats) | scale))


def _networks(policy: Any, critic: Any, obs_stats: Any) -> dict[str, Any]:
    """As they are named in a training state."""
    return {
        "policy": {"params": policy},
        "critic": {"params": critic},
        "obs_stats": obs_stats,
    }


def _scale(std: Any) -> dict[str, Any]:
    """As it is named in a training state."""
    return {"reward_scale": {"returns": {"std": std}}}


def _load_networks(path: Path, config: ResolvedConfig) -> Networks:
    _compare(path, config)
    blank: Any = _blank(config)
    part = _networks(blank.policy.params, blank.critic.params, blank.obs_stats)
    got = load(path, part, part=True)
    policy, critic = (
        InferenceState(got[name]["params"], got["obs_stats"]) for name in ("policy", "critic")
    )
    return Networks(policy, critic, path)


def _compare(path: Path, config: ResolvedConfig) -> None:
    """Arrays of the same shapes may be of another run."""
    for name, (ours, theirs) in differences(config, config_of(path)).items():
        if name not in MAY_CHANGE:
            raise CheckpointError(f"{path}: is of another run, its {name} is {theirs}, here {ours}")


def _blank(config: ResolvedConfig) -> TrainState:
    """Shapes and dtypes of a state."""
    return jax.eval_shape(make_trainer(make_task(config), 1).init, config, seed_keys(config))


def _latest(run_dir: Path, read: Callable[[Path], T]) -> tuple[T, Path]:
    wrong = []
    for path in reversed(checkpoints_in(run_dir / "checkpoints")):
        try:
            result = read(path)
        except DamagedError as reason:
            wrong.append(str(reason))
            continue
        for each in wrong:
            terminal.warn(f"warning: {each}; linear_schedule back to {path.name}")
        return result, path
    raise CheckpointError("; ".join(wrong)) if wrong else _none(run_dir)


def _none(run_dir: Path) -> CheckpointError:
    return CheckpointError(f"{run_dir}: must hold a checkpoint; checkpoints/ has none")
