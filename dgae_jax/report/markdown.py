"""Tables inside Markdown documents.

A table stands between `<!-- dgae report: NAME -->` and `<!-- /dgae report -->`. `NAME of SWEEP`
names the directory of a sweep; a report on another sweep leaves that table alone.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

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

_MARKER = re.compile(r"^<!-- /?dgae report.*-->$", re.MULTILINE)
_BLOCK = re.compile(
    r"(?<=^<!-- dgae report: )(?P<name>.*?)(?: of (?P<sweep>.*?))? -->\n"
    r"(?P<table>.*?)(?=^<!-- /dgae report -->$)",
    re.MULTILINE | re.DOTALL,
)


def replace(path: Path, groups: Sequence[Group], sweep: str) -> list[str]:
    """Replace the tables of a document that are of a sweep, and return their names.

    Raises:
        ConfigError: as `find`, or the file cannot be written.
    """
    text, blocks = find(path, sweep)
    for block in reversed(blocks):
        table = tables.markdown(TABLES[block["name"]](groups))
        text = f"{text[: block.start('table')]}{table}\n{text[block.end('table') :]}"
    try:
        files.replace(path, text.encode())
    except OSError as reason:
        raise _refused(path, f"that can be written ({reason.strerror})") from reason
    return [block["name"] for block in blocks]


def find(path: Path, sweep: str) -> tuple[str, list[re.Match[str]]]:
    """Return the text of a document, and the tables in it that a report on a sweep replaces.

    Raises:
        ConfigError: the file cannot be read, markers are missing or do not match, no table is of
            the sweep, or only some tables name their sweep.
    """
    try:
        text = path.read_bytes().decode()
    except (OSError, UnicodeDecodeError) as reason:
        why = getattr(reason, "strerror", None) or "not text in UTF-8"
        raise _refused(path, f"that can be read ({why})") from reason
    blocks = list(_BLOCK.finditer(text))
    is_known = all(block["name"] in TABLES for block in blocks)
    if not blocks or not is_known or len(_MARKER.findall(text)) != 2 * len(blocks):
        markers = "<!-- dgae report: NAME --> and <!-- /dgae report -->"
        names = ", ".join(TABLES)
        raise _refused(path, f"with tables between lines {markers}; NAME is one of {names}")
    sweeps = dict.fromkeys(block["sweep"] for block in blocks)
    if None in sweeps and len(sweeps) > 1:
        raise _refused(path, "with NAME of SWEEP for all tables, or for none")
    mine = [block for block in blocks if block["sweep"] in (None, sweep)]
    if not mine:
        raise _refused(path, f"with a table of {sweep}; its tables are of {', '.join(sweeps)}")
    return text, mine


def _refused(path: Path, allowed: str) -> ConfigError:
    return invalid("markdown", path, f"a file {allowed}")
