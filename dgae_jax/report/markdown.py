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


def check(path: Path, sweep: str) -> list[str]:
    """Return the names of the tables in a document that a report on a sweep replaces.

    Args:
        path: The document.
        sweep: Name of the sweep's directory.

    Raises:
        ConfigError: the file cannot be read, markers are missing or do not match, no table is of
            the sweep, or only some tables name their sweep.
    """
    return [block["name"] for block in _blocks(path, _text(path), sweep)]


def replace(path: Path, groups: Sequence[Group], sweep: str) -> list[str]:
    """Replace the tables of a document that are of a sweep, and return their names.

    Raises:
        ConfigError: as `check`, or the file cannot be written.
    """
    text = _text(path)
    blocks = _blocks(path, text, sweep)
    for block in reversed(blocks):
        table = tables.markdown(TABLES[block["name"]](groups))
        text = f"{text[: block.start('table')]}{table}\n{text[block.end('table') :]}"
    try:
        files.replace(path, text.encode())
    except OSError as reason:
        raise _refused(path, f"that can be written ({reason.strerror})") from reason
    return [block["name"] for block in blocks]


def _blocks(path: Path, text: str, sweep: str) -> list[re.Match[str]]:
    blocks = list(_BLOCK.finditer(text))
    if not blocks or len(_MARKER.findall(text)) != 2 * len(blocks):
        raise _refused(
            path,
            "with each table between <!-- dgae report: NAME --> and <!-- /dgae report --> on lines "
            "of their own",
        )
    for block in blocks:
        if block["name"] not in TABLES:
            raise _refused(path, f"with tables named {', '.join(TABLES)}, not {block['name']}")
    sweeps = dict.fromkeys(block["sweep"] for block in blocks)
    if None in sweeps and len(sweeps) > 1:
        raise _refused(path, "with NAME of SWEEP for all tables, or for none")
    mine = [block for block in blocks if block["sweep"] in (None, sweep)]
    if not mine:
        raise _refused(path, f"with a table of {sweep}; its tables are of {', '.join(sweeps)}")
    return mine


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode()
    except (OSError, UnicodeDecodeError) as reason:
        why = getattr(reason, "strerror", None) or "not text in UTF-8"
        raise _refused(path, f"that can be read ({why})") from reason


def _refused(path: Path, allowed: str) -> ConfigError:
    return invalid("markdown", path, f"a file {allowed}")
