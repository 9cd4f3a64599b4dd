"""Tables inside documents: what stands between two markers is replaced by the table of that name.

The markers are `<!-- dgae report: NAME -->` and `<!-- /dgae report -->`, on lines of their own.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.report import tables
from dgae_jax.report.groups import Group
from dgae_jax.run import files

TABLES: dict[str, Callable[[Sequence[Group]], tables.Table]] = {
    "returns": tables.returns, "attribution": tables.attribution, "risk": tables.risk, "reach": tables.reach, "speed": tables.speed
}  # fmt: skip

_MARKER = re.compile(r"^<!-- (?:dgae report: (?P<name>.*?)|(?P<end>/dgae report)) -->$", re.MULTILINE)


def blocks(path: Path) -> list[tuple[str, int, int]]:
    """Name, start and end of what stands between each pair of markers; raises ConfigError where they are missing or do not match."""
    markers = list(_MARKER.finditer(_text(path)))
    if not markers:
        raise invalid("markdown", path, "a file with <!-- dgae report: NAME --> and <!-- /dgae report --> on lines of their own")
    openings, ends = markers[::2], markers[1::2]
    for opening, end in zip(openings, [*ends, None], strict=False):
        name = opening["name"]
        if name is None:
            raise invalid("markdown", path, "a file without <!-- /dgae report --> where no table begins")
        if name not in TABLES:
            raise invalid("markdown", path, f"a file with tables named {', '.join(TABLES)}, not {name}")
        if end is None or end["end"] is None:
            raise invalid("markdown", path, f"a file with <!-- /dgae report --> after the table {name}")
    return [(opening["name"], opening.end() + 1, end.start()) for opening, end in zip(openings, ends, strict=True)]


def replace(path: Path, groups: Sequence[Group]) -> list[str]:
    """Replace every block of the file by its table; their names."""
    text, found = _text(path), blocks(path)
    for name, start, end in reversed(found):
        text = text[:start] + tables.markdown(TABLES[name](groups)) + "\n" + text[end:]
    try:
        files.replace(path, text.encode())
    except OSError as reason:
        raise invalid("markdown", path, f"a file that can be written ({reason.strerror})") from reason
    return [name for name, _, _ in found]


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode()
    except (OSError, UnicodeDecodeError) as reason:
        why = getattr(reason, "strerror", None) or "not text in UTF-8"
        raise ConfigError(f"markdown {path}: must be a file that can be read ({why})", "markdown") from reason
