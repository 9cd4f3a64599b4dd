"""How results were made: settings, commands, versions and machines, collapsed until somebody asks."""

from collections.abc import Iterable, Sequence
from typing import Any

from dgae_jax.configs.serial import flat
from dgae_jax.report import html
from dgae_jax.report.groups import SEEDS, Group, shown
from dgae_jax.report.results import Row
from dgae_jax.report.tables import NONE, Table


def cells(groups: Sequence[Group]) -> str:
    """The settings of every cell; what differs from the first of its algorithm is highlighted."""
    firsts: dict[str, Group] = {}
    pieces = [_settings(group, firsts.setdefault(group.algo, group)) for group in groups]
    return html.details("Settings of every cell", *pieces)


def _settings(group: Group, first: Group) -> str:
    ours, theirs = (_of(each) for each in (group, first))
    rows = [(name, shown(value)) for name, value in ours.items()]
    differ = [
        y
        for y, (name, value) in enumerate(ours.items())
        if name not in theirs or theirs[name] != value
    ]
    seeds = ", ".join(str(row.seed) for row in group.rows)
    against = "" if group is first else f"; {len(differ)} differ from {first.name} on {first.task}"
    content = html.table(Table(("setting", "value"), rows, keys=1), {(y, 1) for y in differ})
    return html.details(f"{group.name} on {group.task}, seeds {seeds}{against}", content)


def _of(group: Group) -> dict[str, Any]:
    return {name: value for name, value in flat(group.rows[0].config).items() if name not in SEEDS}


def commands(groups: Iterable[Group]) -> str:
    """The command that made each cell."""
    lines = [
        f"# {row.cell}, seed {row.seed}\n{row.command}" for group in groups for row in group.rows
    ]
    return html.details("The command of every cell", html.code(lines))


def provenance(rows: Iterable[Row]) -> str:
    """Versions, machines and revisions, each with the number of runs that have it."""
    facts = [fact for row in rows for fact in _facts(row)]
    counted = {fact: facts.count(fact) for fact in sorted(set(facts))}
    table = Table(
        ("what", "which", "runs"),
        [(what, which, str(count)) for (what, which), count in counted.items()],
    )
    return html.details("Versions and machines", html.table(table))


def _facts(row: Row) -> list[tuple[str, str]]:
    found = {
        "git revision": row.git_revision,
        **{f"machine: {name}": value for name, value in row.machine.items()},
        **row.versions,
    }
    return [(name, NONE if value is None else str(value)) for name, value in found.items()]
