"""Tables inside Markdown documents, between `<!-- dgae report: NAME -->` and `<!-- /dgae report -->`.

Markers stand on lines of their own. `NAME of SWEEP` names the directory of a sweep; a report on
another sweep leaves that table alone.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.report import analysis, tables
from dgae_jax.report.groups import Group
from dgae_jax.run import files

TABLES: dict[str, Callable[[Sequence[Group]], tables.Table]] = {
    "iqm": tables.interquartile_means,
    "returns": tables.returns,
    "improvement": lambda groups: tables.improvement(analysis.improvements(groups)),
    "attribution": tables.attribution,
    "attribution-over-tasks": tables.attribution_over_tasks,
    "risk": tables.risk,
    "reach": tables.reach,
    "speed": tables.speed,
}

_MARKER = re.compile(
    r"^<!-- (?:dgae report: (?P<name>.*?)(?: of (?P<sweep>.*?))?|/dgae report) -->$", re.MULTILINE
)


class Block(NamedTuple):
    """A table between a pair of markers."""

    name: str
    sweep: str | None
    start: int
    end: int


def blocks(path: Path, sweep: str) -> list[Block]:
    """Return the tables of a document that a report on a sweep replaces.

    Args:
        path: The document.
        sweep: Name of the sweep's directory.

    Raises:
        ConfigError: the file cannot be read, markers are missing or do not match, no table is of
            the sweep, or only some tables name their sweep.
    """
    return _blocks(path, _text(path), sweep)


def replace(path: Path, groups: Sequence[Group], sweep: str) -> list[str]:
    """Replace the tables of a document that are of a sweep.

    Returns:
        Names of the tables.

    Raises:
        ConfigError: as `blocks`, or the file cannot be written.
    """
    text = _text(path)
    found = _blocks(path, text, sweep)
    for block in reversed(found):
        table = tables.markdown(TABLES[block.name](groups))
        text = f"{text[: block.start]}{table}\n{text[block.end :]}"
    try:
        files.replace(path, text.encode())
    except OSError as reason:
        raise _refused(path, f"that can be written ({reason.strerror})") from reason
    return [block.name for block in found]


def _blocks(path: Path, text: str, sweep: str) -> list[Block]:
    markers = list(_MARKER.finditer(text))
    if not markers:
        raise _refused(
            path, "with <!-- dgae report: NAME --> and <!-- /dgae report --> on lines of their own"
        )
    found = []
    for start, end in zip(markers[::2], [*markers[1::2], None], strict=False):
        name = start["name"]
        if name is None:
            raise _refused(path, "without <!-- /dgae report --> before a table begins")
        if name not in TABLES:
            raise _refused(path, f"with tables named {', '.join(TABLES)}, not {name}")
        if end is None or end["name"]:
            raise _refused(path, f"with <!-- /dgae report --> after the table {name}")
        found.append(Block(name, start["sweep"], start.end() + 1, end.start()))
    sweeps = ", ".join(dict.fromkeys(block.sweep for block in found if block.sweep))
    for block in found:
        if sweeps and block.sweep is None:
            raise _refused(
                path, f"with {block.name} of SWEEP, because other tables are of {sweeps}"
            )
    if mine := [block for block in found if block.sweep in (None, sweep)]:
        return mine
    raise _refused(path, f"with a table of {sweep}; its tables are of {sweeps}")


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode()
    except (OSError, UnicodeDecodeError) as reason:
        why = getattr(reason, "strerror", None) or "not text in UTF-8"
        raise _refused(path, f"that can be read ({why})") from reason


def _refused(path: Path, allowed: str) -> ConfigError:
    return invalid("markdown", path, f"a file {allowed}")
