"""Tables inside documents: what stands between two markers is replaced by the table of that name.

The markers are `<!-- dgae report: NAME -->` and `<!-- /dgae report -->`, on lines of their own. With `NAME of STUDY` a table is replaced
by a report on the study in a directory of that name only, so that a document may have tables of several.
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
    "returns": tables.returns,
    "improvement": lambda groups: tables.improvement(analysis.improvements(groups)),
    "attribution": tables.attribution,
    "attribution-over-tasks": tables.attribution_over_tasks,
    "risk": tables.risk,
    "reach": tables.reach,
    "speed": tables.speed,
}

_MARKER = re.compile(
    r"^<!-- (?:dgae report: (?P<name>.*?)(?: of (?P<study>.*?))?|(?P<end>/dgae report)) -->$",
    re.MULTILINE,
)


class Block(NamedTuple):
    """What stands between a pair of markers."""

    name: str
    study: str | None
    start: int
    end: int


def blocks(path: Path, study: str) -> list[Block]:
    """The tables that a report on `study`, the name of its directory, replaces.

    Raises ConfigError where there are none, where the markers are missing or do not match, and where some tables name their study and
    others do not.
    """
    found = _blocks(path)
    studies = ", ".join(dict.fromkeys(block.study for block in found if block.study))
    nameless = next((block.name for block in found if block.study is None), None)
    if nameless and studies:
        raise invalid(
            "markdown",
            path,
            f"a file with {nameless} of STUDY, not {nameless}, where other tables are of {studies}",
        )
    mine = [block for block in found if block.study in (None, study)]
    if not mine:
        raise invalid(
            "markdown", path, f"a file with a table of {study}; its tables are of {studies}"
        )
    return mine


def _blocks(path: Path) -> list[Block]:
    markers = list(_MARKER.finditer(_text(path)))
    if not markers:
        raise invalid(
            "markdown",
            path,
            "a file with <!-- dgae report: NAME --> and <!-- /dgae report --> on lines of their own",
        )
    openings, ends = markers[::2], markers[1::2]
    for opening, end in zip(openings, [*ends, None], strict=False):
        name = opening["name"]
        if name is None:
            raise invalid(
                "markdown", path, "a file without <!-- /dgae report --> where no table begins"
            )
        if name not in TABLES:
            raise invalid(
                "markdown", path, f"a file with tables named {', '.join(TABLES)}, not {name}"
            )
        if end is None or end["end"] is None:
            raise invalid(
                "markdown", path, f"a file with <!-- /dgae report --> after the table {name}"
            )
    return [
        Block(opening["name"], opening["study"], opening.end() + 1, end.start())
        for opening, end in zip(openings, ends, strict=True)
    ]


def replace(path: Path, groups: Sequence[Group], study: str) -> list[str]:
    """Replace every block of the file that is of the study by its table; their names."""
    text, found = _text(path), blocks(path, study)
    for block in reversed(found):
        text = (
            text[: block.start]
            + tables.markdown(TABLES[block.name](groups))
            + "\n"
            + text[block.end :]
        )
    try:
        files.replace(path, text.encode())
    except OSError as reason:
        raise invalid(
            "markdown", path, f"a file that can be written ({reason.strerror})"
        ) from reason
    return [block.name for block in found]


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode()
    except (OSError, UnicodeDecodeError) as reason:
        why = getattr(reason, "strerror", None) or "not text in UTF-8"
        raise ConfigError(
            f"markdown {path}: must be a file that can be read ({why})", "markdown"
        ) from reason
