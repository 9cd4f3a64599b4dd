"""The directory of a run.

`config.json`, `manifest.json`, `metrics.jsonl`, `evaluations.jsonl`, `checkpoints/`, `curve.png`, and at the end `evaluation.json`.
"""

import contextlib
import errno
import fcntl
import glob
import importlib.metadata
import json
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import IO, Any

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.serial import from_dict, to_dict
from dgae_jax.run import files, terminal
from dgae_jax.run.options import RunOptions, read_options
from dgae_jax.run.options import saved_options as options_to_save


class InUseError(ConfigError):
    """A run directory in which another process trains."""


def default_path(config: ResolvedConfig) -> Path:
    """runs/ENV-ALGO-SEED-TIME below the working directory."""
    return (
        Path("runs")
        / f"{config.env.replace('/', '_')}-{config.algo}-{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    )


def create(path: Path, config: ResolvedConfig, options: RunOptions) -> None:
    """Make a new run directory, whole at once, and write what the run is.

    It is built beside, hidden, and moved to its place in one step; what earlier attempts that were killed left there is removed.
    In a directory that exists and is empty `config.json` is written last: without it the directory still counts as empty.
    Raises ConfigError, and writes nothing, if the directory holds anything else or cannot be written.
    """
    try:
        if path.exists():
            if not _is_empty(path):
                raise _used(path)
            _fill(path, config, options)
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        _clean(path)
        with _sibling(path) as sibling:
            _fill(sibling, config, options)
            _move(sibling, path)
        files.sync_directory(path.parent)
    except OSError as reason:
        raise invalid(
            "run_dir", path, f"a directory that can be written ({reason.strerror})"
        ) from reason


def _used(path: Path) -> ConfigError:
    return invalid("run_dir", path, "a new or empty directory")


def _move(made: Path, path: Path) -> None:
    try:
        made.rename(path)
    except OSError as reason:
        if reason.errno in (errno.ENOTEMPTY, errno.EEXIST):  # another process was quicker
            raise _used(path) from reason
        raise


def has_begun(path: Path) -> bool:
    """Whether a run was made at `path`, so that it can be resumed; not where that cannot be seen."""
    try:
        return (path / "config.json").exists()
    except OSError:  # the name is too long, or lies behind a directory that may not be read
        return False


def _is_empty(path: Path) -> bool:
    """Whether there is nothing but what `_fill` leaves when it is killed."""
    return path.is_dir() and all(
        each.name in ("manifest.json", "manifest.json.part", "config.json.part")
        or (
            each.name == "checkpoints"
            and each.is_dir()
            and not each.is_symlink()
            and not any(each.iterdir())
        )
        for each in path.iterdir()
    )


def _fill(path: Path, config: ResolvedConfig, options: RunOptions) -> None:
    (path / "checkpoints").mkdir(exist_ok=True)
    write_manifest(path, options)
    write_config(path, config)


@contextlib.contextmanager
def _sibling(path: Path) -> Iterator[Path]:
    """A hidden directory beside `path`, locked while it is filled, and gone afterwards if it was not moved."""
    made = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent))
    with _held(made):
        try:
            made.chmod(0o777 & ~_umask())
            yield made
        finally:
            shutil.rmtree(made, ignore_errors=True)


def _clean(path: Path) -> None:
    """Remove the siblings that no process holds any more."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        with contextlib.suppress(OSError), _held(left):
            shutil.rmtree(left)


@contextlib.contextmanager
def _held(path: Path) -> Iterator[None]:
    """Lock a directory; raises OSError if another process holds it, or if there are no locks here."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _umask() -> int:
    """Of this process, which can only be seen by setting it."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the run directory, by its metrics; raises ConfigError if another process does. The lock ends with the process."""
    try:
        file = (path / "metrics.jsonl").open("a")
    except OSError as reason:
        raise ConfigError(
            f"{path}: must be a directory that can be written ({reason.strerror})"
        ) from reason
    with file:
        hold(file, InUseError(f"{path}: must not be in use; another process is training there"))
        yield


def hold(file: IO, in_use: ConfigError) -> None:
    """Lock an open file until it is closed; raises `in_use` if another process holds it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise in_use from None
    except OSError as reason:  # some network file systems have no locks
        terminal.warn(
            f"warning: {file.name} cannot be locked ({reason.strerror}): train in it with one process only"
        )


def config_of(source: Path) -> ResolvedConfig:
    """The configuration of a run directory, or of the file of a policy; raises ConfigError if it is neither.

    JAX is loaded for a file only, and MuJoCo never, which a film must do without until its OpenGL is chosen.
    """
    if not _kind(source, Path.is_file):
        return read_config(source)
    from dgae_jax.run import checkpoint

    return checkpoint.config_of(source)


def _kind(path: Path, test: Callable[[Path], bool]) -> bool:
    try:
        return test(path)
    except OSError as reason:
        raise ConfigError(
            f"{path}: must be a run directory, or the file of a policy ({reason.strerror})"
        ) from reason


def read_config(path: Path) -> ResolvedConfig:
    """The configuration of a run; raises ConfigError if `path` is not a run directory, or one with links or devices in it."""
    if not _kind(path, Path.is_dir):
        raise ConfigError(
            f"{path}: must be a run directory; there is {'a file' if path.exists() else 'nothing'} of that name"
        )
    for name in ("checkpoints", "nonfinite", "tensorboard", "wandb", "mlflow"):
        _check_own(path / name, "directory", stat.S_ISDIR)
    for name in (
        "config.json",
        "manifest.json",
        "metrics.jsonl",
        "evaluations.jsonl",
        "sinks.json",
    ):
        _check_own(path / name, "file", stat.S_ISREG)
    with contextlib.suppress(OSError):  # what cannot be read is missed below
        for file in path.glob("checkpoints/steps_*.msgpack"):
            _check_own(file, "file", stat.S_ISREG)
    return read_config_file(path / "config.json")


def _check_own(part: Path, kind: str, is_kind: Callable[[int], bool]) -> None:
    with contextlib.suppress(OSError):  # what is missing is missed by those who need it
        if not is_kind(part.lstat().st_mode):
            raise ConfigError(
                f"{part}: must be a {kind} in the run directory itself, not a link or anything else"
            )


def read_config_file(path: Path) -> ResolvedConfig:
    """A configuration as JSON; raises ConfigError if it cannot be read or is invalid."""
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as reason:
        raise ConfigError(
            f"{path}: must be a configuration that can be read ({getattr(reason, 'strerror', reason)})"
        ) from reason
    try:
        return resolve(from_dict(json.loads(data)))
    except (ValueError, RecursionError) as reason:
        raise ConfigError(f"{path}: {reason}") from reason


def write_config(path: Path, config: ResolvedConfig) -> None:
    """`config.json` of the run directory `path`."""
    files.write_json(path / "config.json", to_dict(config))


_VERSIONS_OF = (
    "dgae_jax",
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "brax",
    "mujoco",
    "mujoco-mjx",
    "playground",
    "gymnasium",
    "numpy",
)


def write_manifest(run_dir: Path, options: RunOptions) -> None:
    """The first part of a run."""
    files.write_json(run_dir / "manifest.json", {**_part(options), "resumed": []})


def extend_manifest(run_dir: Path, options: RunOptions) -> None:
    """A part that continues it."""
    before = _read_manifest(run_dir)
    parts = [*_resumed(before), _part(options)]
    files.write_json(run_dir / "manifest.json", {**before, "resumed": parts})


def saved_options(run_dir: Path) -> RunOptions:
    """The options of the last part of the run, as far as they can be read."""
    return read_options(last_part(run_dir).get("options"))


def environment_changes(run_dir: Path, options: RunOptions) -> list[str]:
    """What decides the bits of a result and is not what it was in the last part of the run."""
    was, now = _deciding(last_part(run_dir)), _deciding(_part(options))
    return [
        f"{name} {value} (was {was.get(name)})"
        for name, value in now.items()
        if was.get(name) != value
    ]


def _deciding(part: dict[str, Any]) -> dict[str, Any]:
    found = {name: part.get(name) for name in ("device", "cores", "processes", "git_revision")}
    for table in (part.get("settings"), part.get("versions")):
        found |= table if isinstance(table, dict) else {}
    options = part.get("options")
    return found | {"devices": options.get("devices") if isinstance(options, dict) else None}


def last_part(run_dir: Path) -> dict[str, Any]:
    """By what the last part of the run was computed; empty if it cannot be read."""
    before = _read_manifest(run_dir)
    part = (_resumed(before) or [before])[-1]
    return part if isinstance(part, dict) else {}


def _read_manifest(run_dir: Path) -> dict[str, Any]:
    """The manifest; empty if there is none that can be understood."""
    try:
        found = json.loads((run_dir / "manifest.json").read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _resumed(manifest: dict[str, Any]) -> list[Any]:
    found = manifest.get("resumed")
    return found if isinstance(found, list) else []


def _part(options: RunOptions) -> dict[str, Any]:
    from dgae_jax.run import runtime

    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": sys.argv,
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **runtime.hardware(),
        "versions": {name: _version(name) for name in _VERSIONS_OF},
        "options": options_to_save(options),
    }


@cache
def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


@cache
def _git_revision() -> str | None:
    """The commit of the source tree, `+` appended where files differ from it; None outside a checkout.

    A busy machine takes its time to say so, and None of a checkout would keep a run from going on.
    """

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", *words],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
        return done.stdout.strip()

    try:
        git(
            "ls-files", "--error-unmatch", Path(__file__).name
        )  # a repository around an installed package is another one
        return git("rev-parse", "HEAD") + (
            "+" if git("status", "--porcelain", "--untracked-files=no") else ""
        )
    except (OSError, subprocess.SubprocessError):
        return None
