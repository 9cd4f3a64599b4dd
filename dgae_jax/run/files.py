"""Files that are written atomically, and files of JSON lines that grow."""

import contextlib
import json
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any


def replace(path: Path, data: bytes) -> None:
    """Write a file atomically: a crash at any byte leaves the old content. No link is followed."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    with _naming(path):
        part.unlink(missing_ok=True)  # of a crash, or a link that was laid there
        try:
            with part.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
        directory = os.open(path.parent, os.O_RDONLY)
        with contextlib.suppress(OSError):  # some network file systems cannot
            os.fsync(directory)  # or the rename may be lost
        os.close(directory)


def write_json(path: Path, data: Any) -> None:
    """Write indented JSON atomically; numbers that are not finite become null."""
    replace(path, (json.dumps(_finite(data), indent=2, allow_nan=False) + "\n").encode())


def read_object(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file, empty if there is none that can be read."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def json_lines(rows: Iterable[dict[str, Any]]) -> bytes:
    """Return one line of JSON per row; numbers that are not finite become null."""
    return "".join(json.dumps(_finite(row), allow_nan=False) + "\n" for row in rows).encode()


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {name: _finite(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def append_rows(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Append rows to a file of JSON lines and flush them to the disk."""
    with _naming(path), path.open("ab") as file:
        file.write(json_lines(rows))
        file.flush()
        os.fsync(file.fileno())


def whole_rows(path: Path) -> Iterator[tuple[dict[str, Any], int]]:
    """Yield each row of JSON lines and the offset of its end, up to a damaged line."""
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
def _naming(path: Path) -> Iterator[None]:
    """Name the file in an OSError, also when a write or a close fails."""
    try:
        yield
    except OSError as reason:
        reason.filename = str(path)
        raise
