"""The directory of a run.

`config.json`, `manifest.json`, `metrics.jsonl`, `evaluations.jsonl`, `checkpoints/`, `curve.png`, and at the end `evaluation.json`.
"""

import contextlib
import fcntl
import json
import stat
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.configs.serial import from_dict, to_dict
from dgae_jax.configs.validation import validate
from dgae_jax.run import files, manifest
from dgae_jax.run.options import RunOptions


def default_path(config: Config) -> Path:
    """runs/ENV-ALGO-SEED-TIME below the working directory."""
    return Path("runs") / f"{config.env}-{config.algo}-{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"


def create(path: Path, config: Config, options: RunOptions) -> None:
    """Make a new run directory and write what the run is.

    Raises ConfigError, and writes nothing, if the directory holds anything already or cannot be written.
    """
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ConfigError(f"--run-dir {path}: must be a new or empty directory")
        (path / "checkpoints").mkdir(parents=True)
        write_config(path, config)
        manifest.write(path, options)
    except OSError as reason:
        raise ConfigError(f"--run-dir {path}: must be a directory that can be written ({reason.strerror})") from reason


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the run directory, by its metrics; raises ConfigError if another process does. The lock ends with the process."""
    try:
        file = (path / "metrics.jsonl").open("a")
    except OSError as reason:
        raise ConfigError(f"{path}: must be a directory that can be written ({reason.strerror})") from reason
    with file:
        _lock(file)
        yield


def _lock(file) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ConfigError(f"{Path(file.name).parent}: must not be in use; another process is training there") from None
    except OSError as reason:  # some network file systems have no locks
        print(f"warning: {file.name} cannot be locked ({reason.strerror}): train in it with one process only", file=sys.stderr)


def read_config(path: Path) -> Config:
    """The configuration of a run; raises ConfigError if `path` is not a run directory, or one with links or devices in it."""
    for name in ("checkpoints", "nonfinite"):
        _check_own(path / name, "directory", stat.S_ISDIR)
    for name in ("config.json", "manifest.json", "metrics.jsonl", "evaluations.jsonl"):
        _check_own(path / name, "file", stat.S_ISREG)
    with contextlib.suppress(OSError):  # what cannot be read is missed below
        for file in path.glob("checkpoints/steps_*.msgpack"):
            _check_own(file, "file", stat.S_ISREG)
    return read_config_file(path / "config.json")


def _check_own(part: Path, kind: str, is_kind: Callable[[int], bool]) -> None:
    with contextlib.suppress(OSError):  # what is missing is missed by those who need it
        if not is_kind(part.lstat().st_mode):
            raise ConfigError(f"{part}: must be a {kind} in the run directory itself, not a link or anything else")


def read_config_file(path: Path) -> Config:
    """A configuration as JSON; raises ConfigError if it cannot be read or cannot be."""
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as reason:
        raise ConfigError(f"{path}: must be a configuration that can be read ({getattr(reason, 'strerror', reason)})") from reason
    try:
        config = from_dict(json.loads(data))
        validate(config)
        return config
    except (ValueError, RecursionError) as reason:
        raise ConfigError(f"{path}: {reason}") from reason


def write_config(path: Path, config: Config) -> None:
    """`config.json` of the run directory `path`."""
    files.write_json(path / "config.json", to_dict(config))
