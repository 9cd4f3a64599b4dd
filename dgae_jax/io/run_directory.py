"""The directory of a run: `config.json`, `manifest.json`, `metrics.jsonl`, `checkpoints/`, `curve.png`, `evaluation.json`."""

import contextlib
import fcntl
import importlib.metadata
import json
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from dgae_jax.config import Config, ConfigError, from_dict, to_dict
from dgae_jax.validation import validate

_VERSIONS_OF = ("dgae_jax", "jax", "jaxlib", "flax", "optax", "brax", "mujoco", "mujoco-mjx", "gymnasium", "numpy")


def default_path(config: Config) -> Path:
    """runs/ENV-ALGO-SEED-TIME below the working directory."""
    return Path("runs") / f"{config.env}-{config.algo}-{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"


def create(path: Path, config: Config) -> None:
    """Make a new run directory and write what the run is.

    Raises ConfigError, and writes nothing, if the directory holds anything already or cannot be written.
    """
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ConfigError(f"--run-dir {path}: must be a new or empty directory")
        (path / "checkpoints").mkdir(parents=True)
        write_json(path / "config.json", to_dict(config))
        write_json(path / "manifest.json", _manifest())
    except OSError as reason:
        raise ConfigError(f"--run-dir {path}: must be a directory that can be written ({reason.strerror})") from reason


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the run directory; raises ConfigError if another process does. The lock ends with the process."""
    with (path / "config.json").open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ConfigError(f"{path}: must not be in use; another process is training there") from None
        yield


def read_config(path: Path) -> Config:
    """The configuration of a run; raises ConfigError if `path` is not a run directory."""
    if not (path / "config.json").is_file():
        raise ConfigError(f"{path}: must be a run directory with a config.json")
    return read_config_file(path / "config.json")


def read_config_file(path: Path) -> Config:
    """A configuration as JSON; raises ConfigError if it cannot be read or cannot be."""
    try:
        config = from_dict(json.loads(path.read_text()))
        validate(config)
        return config
    except OSError as reason:
        raise ConfigError(f"{path}: must be a file that can be read ({reason.strerror})") from reason
    except (ValueError, RecursionError) as reason:
        raise ConfigError(f"{path}: {reason}") from reason


def write_json(path: Path, data: Any) -> None:
    """Indented JSON, in place at once or not at all."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(json.dumps(data, indent=2) + "\n")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _manifest() -> dict[str, Any]:
    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": sys.argv,
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "device": f"{jax.default_backend()}: {jax.devices()[0].device_kind}",
        "versions": {name: _version(name) for name in _VERSIONS_OF},
    }


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_revision() -> str | None:
    """The commit of the source tree, `+` appended where files differ from it; None outside a checkout."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True, timeout=5)
        return done.stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None
