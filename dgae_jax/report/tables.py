"""The tables of a report, once as data and once as Markdown."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from dgae_jax.report import analysis, statistics
from dgae_jax.report.analysis import Estimate
from dgae_jax.report.groups import Group, by_task, order
from dgae_jax.report.published import Published

NONE = "–"


class Table(NamedTuple):
    """Text in rows; the first column says what a row is about, as does the second where `keys` is 2."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    keys: int = 2


def returns(groups: Iterable[Group]) -> Table:
    """Final returns: mean ± standard deviation over seeds, interquartile mean with its interval, each seed's best
    checkpoint, every seed.
    """
    header = (
        "task",
        "algorithm",
        "seeds",
        "mean ± std",
        "IQM [95 %]",
        "best checkpoint",
        "each seed",
    )
    return Table(header, [_returns(group) for group in groups])


def _returns(group: Group) -> tuple[str, ...]:
    best = [row.best for row in group.rows if row.best is not None]
    return (
        group.task, group.name, str(len(group.rows)), spread(group.finals), between(analysis.interquartile_mean(group.finals)),
        spread(best) if best else NONE, " · ".join(number(value) for value in group.finals),
    )  # fmt: skip


def attribution(groups: Iterable[Group]) -> Table:
    """Of variants the final returns, and the returns while training averaged over the run, which depend less on where it ends; both
    as the difference of their interquartile means from that of the first of the task too.
    """
    rows = []
    for members in by_task(groups).values():
        for group in members:
            cells = [group.task, group.name, str(len(group.rows))]
            for scores, first in (
                (group.finals, members[0].finals),
                (group.averages, members[0].averages),
            ):
                cells += [spread(scores), NONE if group is members[0] else _apart(first, scores)]
            rows.append(tuple(cells))
    different = "difference from the first [95 %]"
    return Table(
        (
            "task",
            "variant",
            "seeds",
            "at the end, mean ± std",
            different,
            "over the run, mean ± std",
            different,
        ),
        rows,
    )


def attribution_over_tasks(groups: Iterable[Group]) -> Table:
    """Of variants the probability that a seed is above one of the first variant of its task, at the end and over the run, the mean over
    the tasks.
    """
    duels: dict[str, list[tuple[Group, Group]]] = {}
    for first, *others in by_task(groups).values():
        for group in others:
            duels.setdefault(group.name, []).append((group, first))
    rows = []
    for name, pairs in duels.items():
        cells = [name, str(len(pairs)), str(sum(len(group.rows) for group, _ in pairs))]
        for scores in (lambda group: group.finals, lambda group: group.averages):
            better, worse = zip(
                *((scores(group), scores(first)) for group, first in pairs), strict=True
            )
            cells.append(
                between(analysis.estimate(statistics.improvement, better, worse), "{:.2f}")
            )
        rows.append(tuple(cells))
    return Table(
        (
            "variant",
            "tasks",
            "seeds",
            "above the first at the end [95 %]",
            "above the first over the run [95 %]",
        ),
        rows,
        keys=1,
    )


def risk(groups: Iterable[Group]) -> Table:
    """Final returns: the mean over episodes, and the mean of their worst quarter (CVaR)."""
    rows = []
    for group in groups:
        parts = [
            (spread(scores), between(analysis.interquartile_mean(scores)))
            for scores in (group.finals, group.worst)
        ]
        rows.append((group.task, group.name, str(len(group.rows)), *parts[0], *parts[1]))
    return Table(
        (
            "task",
            "variant",
            "seeds",
            "mean ± std",
            "IQM [95 %]",
            "worst quarter ± std",
            "IQM [95 %]",
        ),
        rows,
    )


def reach(groups: Iterable[Group]) -> Table:
    """Samples after which the mean over seeds of the training return reaches shares of the best mean of the task."""
    rows = []
    for members in by_task(groups).values():
        best = analysis.best_mean(members)
        for group in members:
            found = [
                NONE if steps is None else f"{steps:,}" for steps in analysis.reached(group, best)
            ]
            rows.append((group.task, group.name, NONE if best is None else f"{best:,.0f}", *found))
    return Table(
        (
            "task",
            "algorithm",
            "best mean",
            *(f"samples to {share:.0%}".replace("%", " %") for share in analysis.REACH),
        ),
        rows,
    )


def speed(groups: Iterable[Group]) -> Table:
    """Samples per second and wall-clock time of a run, mean ± standard deviation over seeds, and on what."""
    rows = []
    for group in groups:
        devices = sorted(
            {
                f"{row.machine.get('device', NONE)}, {row.machine.get('cores', NONE)} cores"
                for row in group.rows
            }
        )
        rates, seconds = (
            [getattr(row, name) for row in group.rows] for name in ("samples_per_second", "seconds")
        )
        rows.append((group.task, group.name, spread(rates), spread(seconds), "; ".join(devices)))
    return Table(("task", "algorithm", "samples per second", "seconds per run", "machine"), rows)


def improvement(found: Iterable[analysis.Improvement]) -> Table:
    """Probability of improvement with its interval."""
    rows = [
        (duel.task, f"{duel.better.name} > {duel.worse.name}", between(duel.estimate, "{:.2f}"))
        for duel in found
    ]
    return Table(("task", "pair", "probability [95 %]"), rows)


def others(results: Iterable[Published]) -> Table:
    """Published results and where they are from."""
    rows = []
    for one in results:
        value = number(one.mean) + ("" if one.spread is None else f" ± {number(one.spread)}")
        rows.append(
            (
                one.task,
                one.algorithm,
                f"{one.samples:,}",
                value,
                NONE if one.seeds is None else str(one.seeds),
                one.source,
            )
        )
    return Table(("task", "algorithm", "samples", "mean ± spread", "seeds", "source"), rows)


def comparison(first: Iterable[Group], second: Iterable[Group], names: tuple[str, str]) -> Table:
    """Interquartile means of the final returns of two studies and their difference, second minus first."""
    ours, theirs = (
        {(group.task, group.name): group for group in groups} for groups in (first, second)
    )
    rows, either = [], {**ours, **theirs}
    for key in sorted(either, key=lambda key: order(either[key].rows[0])):
        both = [groups.get(key) for groups in (ours, theirs)]
        cells = [
            NONE if group is None else between(analysis.interquartile_mean(group.finals))
            for group in both
        ]
        rows.append((*key, *cells, _difference(*both)))
    return Table(
        ("task", "algorithm", *(f"{name}, IQM [95 %]" for name in names), "difference [95 %]"), rows
    )


def _difference(first: Group | None, second: Group | None) -> str:
    return NONE if first is None or second is None else _apart(first.finals, second.finals)


def _apart(first: np.ndarray, second: np.ndarray) -> str:
    """The difference of the interquartile means of scores [S], the second's minus the first's."""
    return between(
        analysis.estimate(statistics.difference(statistics.interquartile_mean), [first], [second]),
        "{:+,.0f}",
    )


def number(value: float, form: str = "{:,.0f}") -> str:
    """A number as it is printed."""
    return form.format(value).replace("-", "−")


def spread(values: Sequence[float] | np.ndarray) -> str:
    """Mean ± sample standard deviation."""
    mean, std = statistics.mean_std(np.asarray(values, float))
    return f"{number(mean)} ± {NONE if std is None else number(std)}"


def between(estimate: Estimate, form: str = "{:,.0f}") -> str:
    """A value and its interval."""
    ends = () if estimate.interval is None else estimate.interval
    return (
        f"{number(estimate.value, form)} [{', '.join(number(end, form) for end in ends) or NONE}]"
    )


def markdown(table: Table) -> str:
    """The table in Markdown, numbers to the right."""
    rule = ["---"] * table.keys + ["---:"] * (len(table.header) - table.keys)
    lines = [table.header, rule, *table.rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )
