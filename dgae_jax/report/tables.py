"""Tables of a report: as data, as Markdown, and inside Markdown documents.

A table of a document stands between `<!-- dgae report: NAME -->` and `<!-- /dgae report -->`.
`NAME of SWEEP` names the directory of a sweep; a report on another sweep leaves that table alone.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dgae_jax.configs.config import invalid
from dgae_jax.maths.statistics import iqm
from dgae_jax.report import analysis
from dgae_jax.report.analysis import Estimate
from dgae_jax.report.groups import Group, by_task, order
from dgae_jax.report.results import Published
from dgae_jax.run import files

NONE = "–"
IQM = "IQM [95 %]"


class Table(NamedTuple):
    """Text in rows; the first `keys` columns name the row."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    keys: int = 2


def interquartile_means(groups: Iterable[Group]) -> Table:
    """Interquartile means of the final returns: a row per task, a column per algorithm."""
    tasks = by_task(groups)
    names = list(dict.fromkeys(group.name for members in tasks.values() for group in members))
    rows = []
    for task, members in tasks.items():
        means = {group.name: number(float(iqm(group.finals))) for group in members}
        rows.append((task, *(means.get(name, NONE) for name in names)))
    return Table(("task", *names), rows, keys=1)


def returns(groups: Iterable[Group]) -> Table:
    """Final returns, and the best checkpoint of each seed."""
    rows = []
    for group in groups:
        best = [row.best for row in group.rows if row.best is not None]
        seeds = " · ".join(number(value) for value in group.finals)
        rows.append((*_key(group), *_scores(group.finals), spread(best) if best else NONE, seeds))
    names = ("task", "algorithm", "seeds", "mean ± std", IQM, "best checkpoint", "each seed")
    return Table(names, rows)


def attribution(groups: Iterable[Group]) -> Table:
    """Variants against the first of their task, by final return and by the mean during training.

    The mean during training depends less on where the run ends.
    """
    rows = []
    for members in by_task(groups).values():
        first = members[0]
        for group in members:
            pairs = (first.finals, group.finals), (first.averages, group.averages)
            texts = [
                (spread(ours), NONE if group is first else _difference(theirs, ours))
                for theirs, ours in pairs
            ]
            rows.append((*_key(group), *texts[0], *texts[1]))
    different = "difference from the first [95 %]"
    end, run = "at the end, mean ± std", "over the run, mean ± std"
    return Table(("task", "variant", "seeds", end, different, run, different), rows)


def attribution_over_tasks(groups: Iterable[Group]) -> Table:
    """Probability that a seed of a variant scores above one of the first variant of its task."""
    duels: dict[str, list[tuple[Group, Group]]] = {}
    for first, *others in by_task(groups).values():
        for group in others:
            duels.setdefault(group.name, []).append((group, first))
    rows = []
    for name, pairs in duels.items():
        end = analysis.improvement([a.finals for a, _ in pairs], [b.finals for _, b in pairs])
        run = analysis.improvement([a.averages for a, _ in pairs], [b.averages for _, b in pairs])
        seeds = sum(len(group.rows) for group, _ in pairs)
        shares = between(end, "{:.2f}"), between(run, "{:.2f}")
        rows.append((name, str(len(pairs)), str(seeds), *shares))
    above = [f"above the first {when} [95 %]" for when in ("at the end", "over the run")]
    return Table(("variant", "tasks", "seeds", *above), rows, keys=1)


def risk(groups: Iterable[Group]) -> Table:
    """Final returns: the mean over episodes, and the mean of their worst quarter (CVaR)."""
    rows = [(*_key(group), *_scores(group.finals), *_scores(group.worst)) for group in groups]
    header = ("task", "variant", "seeds", "mean ± std", IQM, "worst quarter ± std", IQM)
    return Table(header, rows)


def reach(groups: Iterable[Group]) -> Table:
    """Samples until the mean training return reaches shares of the task's best mean."""
    rows = []
    for members in by_task(groups).values():
        best, steps = analysis.reached(members)
        for group, reached in zip(members, steps, strict=True):
            found = [NONE if value is None else f"{value:,.0f}" for value in (best, *reached)]
            rows.append((group.task, group.name, *found))
    shares = [f"samples to {100 * share:.0f} %" for share in analysis.REACH]
    return Table(("task", "algorithm", "best mean", *shares), rows)


def speed(groups: Iterable[Group]) -> Table:
    """Samples per second and wall-clock time of a run, with its machine."""
    rows = []
    for group in groups:
        machines = {
            f"{row.machine.get('device', NONE)}, {row.machine.get('cores', NONE)} cores"
            for row in group.rows
        }
        rates = spread([row.samples_per_second for row in group.rows])
        seconds = spread([row.seconds for row in group.rows])
        rows.append((group.task, group.name, rates, seconds, "; ".join(sorted(machines))))
    return Table(("task", "algorithm", "samples per second", "seconds per run", "machine"), rows)


def improvement(found: Iterable[analysis.Improvement]) -> Table:
    """Probabilities of improvement."""
    rows = [
        (duel.task, f"{duel.better.name} > {duel.worse.name}", between(duel.estimate, "{:.2f}"))
        for duel in found
    ]
    return Table(("task", "pair", "probability [95 %]"), rows)


def published(results: Iterable[Published]) -> Table:
    """Published results with their sources."""
    rows = []
    for one in results:
        value = number(one.mean) + ("" if one.spread is None else f" ± {number(one.spread)}")
        seeds = str(one.seeds or NONE)
        rows.append((one.task, one.algorithm, f"{one.samples:,}", value, seeds, one.source))
    return Table(("task", "algorithm", "samples", "mean ± spread", "seeds", "source"), rows)


def comparison(first: Iterable[Group], second: Iterable[Group], names: tuple[str, str]) -> Table:
    """Interquartile means of the final returns of two sweeps, and second minus first."""
    ours, theirs = (
        {(group.task, group.name): group for group in groups} for groups in (first, second)
    )
    rows, either = [], {**ours, **theirs}
    for key in sorted(either, key=lambda key: order(either[key].rows[0])):
        finals = [groups[key].finals if key in groups else None for groups in (ours, theirs)]
        means = [NONE if x is None else between(analysis.interquartile_mean(x)) for x in finals]
        one, two = finals
        rows.append((*key, *means, NONE if one is None or two is None else _difference(one, two)))
    columns = [f"{name}, {IQM}" for name in names]
    return Table(("task", "algorithm", *columns, "difference [95 %]"), rows)


def _key(group: Group) -> tuple[str, str, str]:
    return group.task, group.name, str(len(group.rows))


def _scores(scores: np.ndarray) -> tuple[str, str]:
    return spread(scores), between(analysis.interquartile_mean(scores))


def _difference(first: np.ndarray, second: np.ndarray) -> str:
    return between(analysis.difference(first, second), "{:+,.0f}")


def number(value: float, form: str = "{:,.0f}") -> str:
    """Format a number, with a true minus sign."""
    return form.format(value).replace("-", "−")


def spread(values: Sequence[float] | np.ndarray) -> str:
    """Format mean ± sample standard deviation."""
    std = number(float(np.std(values, ddof=1))) if len(values) > 1 else NONE
    return f"{number(float(np.mean(values)))} ± {std}"


def between(estimate: Estimate, form: str = "{:,.0f}") -> str:
    """Format a value and its interval."""
    ends = () if estimate.interval is None else estimate.interval
    interval = ", ".join(number(end, form) for end in ends) or NONE
    return f"{number(estimate.value, form)} [{interval}]"


def markdown(table: Table) -> str:
    """Format a table in Markdown, numbers aligned to the right."""
    rule = ["---"] * table.keys + ["---:"] * (len(table.header) - table.keys)
    lines = [table.header, rule, *table.rows]
    return "\n".join(
        "| " + " | ".join(text.replace("|", "\\|") for text in line) + " |" for line in lines
    )


TABLES: dict[str, Callable[[Sequence[Group]], Table]] = {
    "iqm": interquartile_means,
    "returns": returns,
    "improvement": lambda groups: improvement(analysis.improvements(groups)),
    "attribution": attribution,
    "attribution-over-tasks": attribution_over_tasks,
    "risk": risk,
    "reach": reach,
    "speed": speed,
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
            table = markdown(TABLES[block["name"]](groups))
            text = f"{text[: block.start('table')]}{table}\n{text[block.end('table') :]}"
        files.replace(path, text.encode())
    except (OSError, UnicodeDecodeError) as reason:
        raise invalid("markdown", path, f"a file that can be read and written ({reason})") from None
    return [block["name"] for block in mine]
