"""The run directory and its manifest.

It holds `config.json`, `manifest.json`, `metrics.jsonl`, `evaluations.jsonl`, `checkpoints/`,
`curve.png`, and at the end `evaluation.json`. Importing this module does not import JAX.
"""

import contextlib
import fcntl
import importlib.metadata
import json
import platform
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import IO, Any

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.serial import from_dict, to_dict
from dgae_jax.run import files, options, terminal
from dgae_jax.run.options import RunOptions

VERSIONED = (
    "dgae_jax", "jax", "jaxlib", "flax", "optax", "brax", "mujoco", "mujoco-mjx", "playground",
    "gymnasium", "numpy",
)  # fmt: skip
"""Packages to record the versions of."""

OWN_DIRECTORIES = ("checkpoints", "nonfinite", "tensorboard", "wandb", "mlflow")
OWN_FILES = ("config.json", "manifest.json", "metrics.jsonl", "evaluations.jsonl", "sinks.json")


class InUseError(ConfigError):
    """A run directory in which another process trains."""


def default_path(config: ResolvedConfig) -> Path:
    """Return runs/ENV-ALGO-SEED-TIME below the working directory."""
    name = f"{config.env.replace('/', '_')}-{config.algo}-{config.seed}"
    return Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"


@contextlib.contextmanager
def created(path: Path, config: ResolvedConfig, options: RunOptions) -> Iterator[None]:
    """Make a new run directory and hold it.

    `config.json` is written last: without it a directory counts as empty, and no run has begun.

    Raises:
        ConfigError: the directory holds anything else, or cannot be written.
    """
    with _writing(path):
        path.mkdir(parents=True, exist_ok=True)
        _check_empty(path)
    with locked(path):
        _check_empty(path)  # again: another process may have been quicker
        with _writing(path):
            (path / "checkpoints").mkdir(exist_ok=True)
            files.write_json(path / "manifest.json", {**_part(options), "resumed": []})
            write_config(path, config)
        yield


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as reason:
        allowed = f"a directory that can be written ({reason.strerror})"
        raise invalid("run_dir", path, allowed) from reason


def _check_empty(path: Path) -> None:
    """Refuse a directory that holds more than `created` leaves when it is killed."""
    left = {"manifest.json", "manifest.json.part", "config.json.part"}
    for each in path.iterdir():
        unused = each.name == "metrics.jsonl" and not each.is_symlink() and not each.stat().st_size
        empty = each.name == "checkpoints" and not each.is_symlink() and not any(each.iterdir())
        if not (each.name in left or unused or empty):
            raise invalid("run_dir", path, "a new or empty directory")


def has_begun(path: Path) -> bool:
    """Return whether a run was made at `path`, so that it can be resumed."""
    try:
        return (path / "config.json").exists()
    except OSError:  # a name that is too long, or a directory that may not be read
        return False


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the run directory, by its metrics; the lock ends with the process.

    Raises:
        InUseError: another process trains there.
        ConfigError: the directory cannot be written.
    """
    try:
        file = (path / "metrics.jsonl").open("a")
    except OSError as reason:
        must = f"must be a directory that can be written ({reason.strerror})"
        raise ConfigError(f"{path}: {must}") from reason
    with file:
        hold(file, InUseError(f"{path}: must not be in use; another process is training there"))
        yield


def hold(file: IO, in_use: ConfigError) -> None:
    """Lock an open file until it is closed; raise `in_use` if another process holds it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise in_use from None
    except OSError as reason:  # some network file systems have no locks
        why = f"cannot be locked ({reason.strerror}): use it with one process only"
        terminal.warn(f"warning: {file.name} {why}")


def config_of(source: Path) -> ResolvedConfig:
    """Return the configuration of a run directory, or of a policy file, for which JAX is imported.

    Raises:
        ConfigError: `source` is neither.
    """
    if not _is(source, Path.is_file):
        return read_config(source)
    from dgae_jax.run import checkpoint

    return checkpoint.config_of(source)


def read_config(path: Path) -> ResolvedConfig:
    """Return the configuration of a run directory.

    Raises:
        ConfigError: `path` is no run directory, or has links or devices in it.
    """
    if not _is(path, Path.is_dir):
        there = "a file" if path.exists() else "nothing"
        raise ConfigError(f"{path}: must be a run directory; there is {there} of that name")
    for name in OWN_DIRECTORIES:
        _check_own(path / name, "directory", stat.S_ISDIR)
    with contextlib.suppress(OSError):  # what cannot be read is missed below
        for file in [*(path / name for name in OWN_FILES), *path.glob("checkpoints/steps_*")]:
            _check_own(file, "file", stat.S_ISREG)
    return read_config_file(path / "config.json")


def _is(path: Path, test: Callable[[Path], bool]) -> bool:
    try:
        return test(path)
    except OSError as reason:
        must = f"must be a run directory or a policy file ({reason.strerror})"
        raise ConfigError(f"{path}: {must}") from reason


def _check_own(part: Path, kind: str, is_kind: Callable[[int], bool]) -> None:
    with contextlib.suppress(OSError):  # what is missing is missed by those who need it
        if not is_kind(part.lstat().st_mode):
            raise ConfigError(f"{part}: must be a {kind} in the run directory, not a link")


def read_config_file(path: Path) -> ResolvedConfig:
    """Return the configuration in a file of JSON.

    Raises:
        ConfigError: it cannot be read or is invalid.
    """
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as reason:
        why = getattr(reason, "strerror", reason)
        raise ConfigError(f"{path}: must be a configuration that can be read ({why})") from reason
    try:
        return resolve(from_dict(json.loads(data)))
    except (ValueError, RecursionError) as reason:
        raise ConfigError(f"{path}: {reason}") from reason


def write_config(path: Path, config: ResolvedConfig) -> None:
    """Write `config.json` of the run directory `path`."""
    files.write_json(path / "config.json", to_dict(config))


def extend_manifest(run_dir: Path, options: RunOptions) -> None:
    """Add the part that resumes a run to `manifest.json`."""
    before = files.read_object(run_dir / "manifest.json")
    parts = [*_resumed(before), _part(options)]
    files.write_json(run_dir / "manifest.json", {**before, "resumed": parts})


def saved_options(run_dir: Path) -> RunOptions:
    """Return the options of the last part of the run, as far as they can be read."""
    return options.read_options(last_part(run_dir).get("options"))


def environment_changes(run_dir: Path, options: RunOptions) -> list[str]:
    """Return what the bits of a result depend on and is not what it was, with both values."""
    was, now = _environment(last_part(run_dir)), _environment(_part(options))
    changed = ((name, value) for name, value in now.items() if was.get(name) != value)
    return [f"{name} {value} (was {was.get(name)})" for name, value in changed]


def _environment(part: dict[str, Any]) -> dict[str, Any]:
    found = {name: part.get(name) for name in ("device", "cores", "processes", "git_revision")}
    for table in (part.get("settings"), part.get("versions")):
        found |= table if isinstance(table, dict) else {}
    options = part.get("options")
    return found | {"devices": options.get("devices") if isinstance(options, dict) else None}


def last_part(run_dir: Path) -> dict[str, Any]:
    """Return the last part of the manifest; empty if it cannot be read."""
    before = files.read_object(run_dir / "manifest.json")
    part = (_resumed(before) or [before])[-1]
    return part if isinstance(part, dict) else {}


def _resumed(manifest: dict[str, Any]) -> list[Any]:
    found = manifest.get("resumed")
    return found if isinstance(found, list) else []


def _part(chosen: RunOptions) -> dict[str, Any]:
    from dgae_jax.run import runtime  # JAX is loaded when a run begins

    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": sys.argv,
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **runtime.hardware(),
        "versions": {name: _version(name) for name in VERSIONED},
        "options": options.saved_options(chosen),
    }


@cache
def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


@cache
def _git_revision() -> str | None:
    """Return the commit, `+` appended where files differ from it; None outside a checkout."""

    def git(*words: str) -> str:
        how: dict[str, Any] = {"cwd": Path(__file__).parent, "capture_output": True, "text": True}
        # a busy machine takes its time, and None in a checkout would refuse a resume
        return subprocess.run(["git", *words], check=True, timeout=60, **how).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # not a repository around it
        differs = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+" if differs else "")
    except (OSError, subprocess.SubprocessError):
        return None
