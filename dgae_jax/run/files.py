"""Files that are whole or not there, and files that grow line by line."""

import contextlib
import errno
import fcntl
import json
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any


def replace(path: Path, data: bytes) -> None:
    """`data` as the file `path`, complete or not at all: a crash at any byte leaves what was there. No link is followed."""
    part = path.with_name(path.name + ".part")
    with _named(path):
        part.unlink(missing_ok=True)  # of a crash, or a link that was laid there
        try:
            with part.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
            sync_directory(path.parent)
        finally:
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def turn(directory: Path) -> Iterator[None]:
    """Of several processes that write the same files in a directory one after the other; all at once where there are no locks."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some network file systems have none
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def beside(source: Path, name: str) -> Path:
    """Where what was made of a run is written: in its directory, or beside the file of a policy, with its name in front."""
    return source.with_name(f"{source.stem}-{name}") if source.is_file() else source / name


def sync_directory(path: Path) -> None:
    """The names in a directory are on the disk when this returns; a rename alone may be lost with the power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as reason:
        if reason.errno not in (errno.EINVAL, errno.ENOTSUP):  # some network file systems cannot
            raise
    finally:
        os.close(descriptor)


def write_json(path: Path, data: Any) -> None:
    """Indented JSON, complete or not at all; numbers that are not finite are null."""
    replace(path, (_json(data, indent=2) + "\n").encode())


def json_lines(rows: Iterable[dict[str, Any]]) -> bytes:
    """One line of JSON per row; numbers that are not finite are null."""
    return "".join(_json(row) + "\n" for row in rows).encode()


def _json(data: Any, indent: int | None = None) -> str:
    return json.dumps(_finite(data), indent=indent, allow_nan=False)


def _finite(data: Any) -> Any:
    """JSON has no word for NaN and infinity."""
    if isinstance(data, dict):
        return {name: _finite(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def append_rows(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Add rows to a file of JSON lines; they are on the disk, ahead of whatever is written next, when this returns."""
    with _named(path), path.open("ab") as file:
        file.write(json_lines(rows))
        file.flush()
        os.fsync(file.fileno())


def whole_rows(path: Path) -> Iterator[tuple[dict[str, Any], int]]:
    """Each row of a file of JSON lines and the offset behind it, up to the first line that is torn or not a row."""
    end = 0
    with path.open("rb") as file:
        for line in file:
            end += len(line)
            try:
                row = json.loads(line)
            except (ValueError, RecursionError):
                return
            if not (isinstance(row, dict) and line.endswith(b"\n")):
                return
            yield row, end


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors of the operating system say which file they are about, also when a write or a close fails."""
    try:
        yield
    except OSError as reason:
        reason.filename = str(path)
        raise
