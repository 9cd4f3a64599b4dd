"""The run directory and its manifest.

It holds `config.json`, `manifest.json`, `metrics.jsonl`, `evaluations.jsonl`, `checkpoints/`,
`curve.png`, and at the end `evaluation.json`. Importing this module does not import JAX.
"""

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
from typing import IO, Any

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.serial import flat, from_dict, to_dict
from dgae_jax.run import files, terminal
from dgae_jax.run.options import RunOptions, SavedOptions

VERSIONED = (
    "dgae_jax", "jax", "jaxlib", "flax", "optax", "brax", "mujoco", "mujoco-mjx", "playground",
    "gymnasium", "numpy",
)  # fmt: skip
"""Packages to record the versions of."""


class InUseError(ConfigError):
    """A run directory in which another process trains."""


def default_path(config: ResolvedConfig) -> Path:
    """Return runs/ENV-ALGO-SEED-TIME below the working directory."""
    name = f"{config.env.replace('/', '_')}-{config.algo}-{config.seed}"
    return Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"


@contextlib.contextmanager
def created(path: Path, config: ResolvedConfig, options: RunOptions) -> Iterator[None]:
    """Make a new run directory and hold it; refuse one that holds anything else.

    `config.json` is written last: without it a directory counts as empty, and no run has begun.
    """
    with must_be("a directory that can be written", path):
        path.mkdir(parents=True, exist_ok=True)
        _check_empty(path)
    with locked(path):
        _check_empty(path)  # again: another process may have been quicker
        with must_be("a directory that can be written", path):
            (path / "checkpoints").mkdir(exist_ok=True)
            files.write_json(path / "manifest.json", {**_part(options), "resumed": []})
            files.write_json(path / "config.json", to_dict(config))
        yield


@contextlib.contextmanager
def must_be(what: str, path: Path, setting: str = "") -> Iterator[None]:
    """Turn an OSError into a ConfigError that says what `path` must be."""
    try:
        yield
    except OSError as reason:
        message = f"{setting} {path}: must be {what} ({reason.strerror})".lstrip()
        raise ConfigError(message, setting) from reason


def _check_empty(path: Path) -> None:
    """Refuse a directory that holds more than `created` leaves when it is killed."""
    for each in path.iterdir():
        left = each.name == "manifest.json" or each.suffix == ".part"
        unused = each.name == "metrics.jsonl" and not each.lstat().st_size
        empty = each.name == "checkpoints" and not (each.is_symlink() or any(each.iterdir()))
        if not (left or unused or empty):
            raise invalid("run_dir", path, "a new or empty directory")


def has_begun(path: Path) -> bool:
    """Return whether a run was made at `path`, so that it can be resumed."""
    with contextlib.suppress(OSError):  # a name that is too long, or an unreadable directory
        return (path / "config.json").exists()
    return False


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the run directory, by its metrics; the lock ends with the process."""
    with must_be("a directory that can be written", path):
        file = (path / "metrics.jsonl").open("a")
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
    """Return the configuration of a run directory or policy file; raise ConfigError for others."""
    with must_be("a run directory or a policy file", source):
        if not source.is_file():
            return read_config(source)
    from dgae_jax.run import checkpoint

    return checkpoint.read(source)[0]


def read_config(path: Path) -> ResolvedConfig:
    """Return the configuration of a run directory; raise ConfigError if it has links or pipes."""
    with must_be("a run directory", path):
        for each in [*path.iterdir(), *path.glob("checkpoints/*")]:
            if each.is_symlink() or each.is_fifo():
                raise ConfigError(f"{each}: must be a file or directory, not a link or pipe")
    return read_config_file(path / "config.json")


def read_config_file(path: Path) -> ResolvedConfig:
    """Return the configuration in a file of JSON; raise ConfigError if there is none."""
    with must_be("a configuration that can be read", path):
        data = path.read_bytes()
    try:
        return resolve(from_dict(json.loads(data)))
    except (ValueError, RecursionError) as reason:
        raise ConfigError(f"{path}: {reason}") from reason


def continue_run(run_dir: Path, config: ResolvedConfig, options: RunOptions) -> None:
    """Write the configuration, and add the part that resumes a run to `manifest.json`."""
    files.write_json(run_dir / "config.json", to_dict(config))
    before = files.read_object(run_dir / "manifest.json")
    resumed = [*before.get("resumed", []), _part(options)]
    files.write_json(run_dir / "manifest.json", {**before, "resumed": resumed})


def saved_options(run_dir: Path) -> RunOptions:
    """Return the options of the last part of the run that a resume keeps."""
    found = last_part(run_dir).get("options", {})
    return RunOptions(
        **{name: found[name] for name in SavedOptions.__annotations__ if name in found}
    )


def environment_changes(run_dir: Path, options: RunOptions) -> list[str]:
    """Return what the bits of a result depend on and is not what it was, with both values."""
    was, now = flat(last_part(run_dir)), flat(_part(options))
    same = {"device", "cores", "processes", "git_revision", "options.devices"}
    same |= {name for name in now if name.startswith(("settings.", "versions."))}
    pairs = ((name, was.get(name), value) for name, value in now.items() if name in same)
    return [
        f"{name.rpartition('.')[2]} {new} (was {old})" for name, old, new in pairs if new != old
    ]


def last_part(run_dir: Path) -> dict[str, Any]:
    """Return the last part of the manifest; empty if it cannot be read."""
    manifest = files.read_object(run_dir / "manifest.json")
    return [manifest, *manifest.get("resumed", [])][-1]


def _part(options: RunOptions) -> dict[str, Any]:
    from dgae_jax.run import runtime  # JAX is loaded when a run begins

    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": sys.argv,
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **runtime.hardware(),
        "versions": {name: _version(name) for name in VERSIONED},
        "options": {name: getattr(options, name) for name in SavedOptions.__annotations__},
    }


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_revision() -> str | None:
    """Return the commit, `+` appended where files differ from it; None outside a checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():  # installed, perhaps inside another repository
        return None
    version = ["git", "describe", "--always", "--dirty=+", "--abbrev=40", "--exclude=*"]
    try:
        # a busy machine takes its time, and None in a checkout would refuse a resume
        how: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 60}
        return subprocess.run(version, cwd=root, check=True, **how).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
