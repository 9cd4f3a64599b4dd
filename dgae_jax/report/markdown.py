"""Tables inside Markdown documents.

A table stands between `<!-- dgae report: NAME -->` and `<!-- /dgae report -->`. `NAME of SWEEP`
names the directory of a sweep; a report on another sweep leaves that table alone.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from dgae_jax.configs.config import invalid
from dgae_jax.report import analysis, tables
from dgae_jax.report.groups import Group
from dgae_jax.run import files

TABLES: dict[str, Callable[[Sequence[Group]], tables.Table]] = {
    "iqm": tables.interquartile_means,
    "returns": tables.returns,
    "improvement": lambda groups: tables.improvement(analysis.improvements(groups)),
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
        ConfigError: the file cannot be read or written, markers do not match, or no table is of
            the sweep.
    """
    try:
        text = path.read_bytes().decode()
        blocks = list(_BLOCK.finditer(text))
        known = [block for block in blocks if block["name"] in TABLES]
        mine = [block for block in known if block["sweep"] in (None, sweep)]
        if not mine or len(_MARKER.findall(text)) != 2 * len(known):
            markers = "<!-- dgae report: NAME --> and <!-- /dgae report -->"
            allowed = f"a file with tables of {sweep} between lines {markers}"
            raise invalid("markdown", path, f"{allowed}; NAME is one of {', '.join(TABLES)}")
        for block in reversed(mine):
            table = tables.markdown(TABLES[block["name"]](groups))
            text = f"{text[: block.start('table')]}{table}\n{text[block.end('table') :]}"
        files.replace(path, text.encode())
    except (OSError, UnicodeDecodeError) as reason:
        raise invalid("markdown", path, f"a file that can be read and written ({reason})") from None
    return [block["name"] for block in mine]
