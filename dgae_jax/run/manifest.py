"""`manifest.json`: by what a run was computed, and what of that is different now."""

import importlib.metadata
import json
import platform
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

from dgae_jax.run import files
from dgae_jax.run.options import RunOptions, from_dict, to_dict

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


def write(run_dir: Path, options: RunOptions) -> None:
    """The first part of a run."""
    files.write_json(run_dir / "manifest.json", {**_now(options), "resumed": []})


def add(run_dir: Path, options: RunOptions) -> None:
    """A part that continues it."""
    before = _read(run_dir)
    parts = [*_resumed(before), _now(options)]
    files.write_json(run_dir / "manifest.json", {**before, "resumed": parts})


def options(run_dir: Path) -> RunOptions:
    """The options of the last part of the run, as far as they can be read."""
    return from_dict(last(run_dir).get("options"))


def changes(run_dir: Path, options: RunOptions) -> list[str]:
    """What decides the bits of a result and is not what it was in the last part of the run."""
    was, now = _deciding(last(run_dir)), _deciding(_now(options))
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


def last(run_dir: Path) -> dict[str, Any]:
    """By what the last part of the run was computed; empty if it cannot be read."""
    before = _read(run_dir)
    part = (_resumed(before) or [before])[-1]
    return part if isinstance(part, dict) else {}


def _read(run_dir: Path) -> dict[str, Any]:
    """The manifest; empty if there is none that can be understood."""
    try:
        found = json.loads((run_dir / "manifest.json").read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _resumed(manifest: dict[str, Any]) -> list[Any]:
    found = manifest.get("resumed")
    return found if isinstance(found, list) else []


def _now(options: RunOptions) -> dict[str, Any]:
    from dgae_jax.run import machine  # JAX is loaded when a run begins, not to read an old manifest

    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": sys.argv,
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **machine.facts(),
        "versions": {name: _version(name) for name in _VERSIONS_OF},
        "options": to_dict(options),
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
