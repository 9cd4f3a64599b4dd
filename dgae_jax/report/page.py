"""The files of a report: its figures, and one page of HTML from `templates/page.html`."""

import base64
import gc
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from dgae_jax.configs.config import invalid
from dgae_jax.report import analysis, figures, tables
from dgae_jax.report.groups import Group, by_task, groups_of, shown
from dgae_jax.report.results import Published, Sweep
from dgae_jax.report.tables import NONE, Table
from dgae_jax.run import files
from dgae_jax.run.terminal import counted


def write(sweeps: Sequence[Sweep], out: Path, published: Sequence[Published] = ()) -> list[Path]:
    """Write report.html and the figures of each sweep.

    Args:
        sweeps: The sweeps; several are compared with the first.
        out: Directory, made if needed. With several sweeps, figures are numbered by sweep.
        published: Published results to draw.

    Returns:
        The files in the order of writing.

    Raises:
        ConfigError: `out` cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        written = []
        for number, sweep in enumerate(sweeps, start=1):
            prefix = f"{number}-" if len(sweeps) > 1 else ""
            for name, figure in _drawn(groups_of(sweep.rows), published):
                written += figures.save(figure, out / (prefix + name))
        gc.collect()  # figures are full of reference cycles
        html = out / "report.html"
        files.replace(html, page(sweeps, published).encode())
    except OSError as reason:
        raise invalid(
            "out", out, f"a directory that can be written ({reason.strerror})"
        ) from reason
    return [*written, html]


def _drawn(groups: list[Group], published: Sequence[Published]) -> Iterator[tuple[str, Figure]]:
    yield "learning", figures.learning_curves(groups, published)
    yield "returns", figures.final_returns(groups)
    if found := analysis.improvements(groups):
        yield "improvement", figures.improvement(found)
    if analysis.normalised(groups):
        yield "profile", figures.performance_profile(groups)
    yield "speed", figures.speed(groups)


def page(sweeps: Sequence[Sweep], published: Sequence[Published] = ()) -> str:
    """Return the page: a comparison with the first sweep if there are several, then each sweep."""
    environment = Environment(
        loader=PackageLoader("dgae_jax.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"counted": counted, "number": tables.number, "some": _some}
    reports = [_content(sweep, published) for sweep in sweeps]
    first, *others = reports
    comparisons = [
        tables.comparison(first["groups"], other["groups"], (first["name"], other["name"]))
        for other in others
    ]
    return environment.get_template("page.html").render(
        title=" and ".join(sweep.name for sweep in sweeps),
        reports=reports,
        comparisons=comparisons,
        crosses=bool(published),
    )


def _content(sweep: Sweep, published: Sequence[Published]) -> dict[str, Any]:
    """Return what the template shows of one sweep."""
    groups = groups_of(sweep.rows)
    tasks = by_task(groups)
    envs = {row.env for row in sweep.rows}
    known = [one for one in published if one.task in envs]
    duels, scores = analysis.improvements(groups), analysis.normalised(groups)

    def per_task(draw: Callable[..., Figure], *args: Any) -> list[tuple[list[Group], str]]:
        return [(members, _svg_uri(draw(members, *args))) for members in tasks.values()]

    return {
        "name": sweep.name,
        "rows": sweep.rows,
        "missing": sweep.missing,
        "diverged": [f"seed {seed} of {run}" for run, seed in sweep.diverged],
        "steps": sorted({row.total_steps for row in sweep.rows}),
        "engines": sorted({row.engine for row in sweep.rows}),
        "groups": groups,
        "duels": duels,
        "scores": scores,
        "final_returns": per_task(figures.final_returns),
        "learning_curves": per_task(figures.learning_curves, known),
        "improvement": _svg_uri(figures.improvement(duels)) if duels else None,
        "profile": _svg_uri(figures.performance_profile(groups)) if scores else None,
        "speed": per_task(figures.speed),
        "returns_table": tables.returns(groups),
        "published_table": tables.published(known) if known else None,
        "improvement_table": tables.improvement(duels),
        "reach_table": tables.reach(groups),
        "speed_table": tables.speed(groups),
        "versions_table": _versions(sweep),
        "settings": _settings(groups),
        "videos": _videos(sweep, tasks),
    }


def _videos(sweep: Sweep, tasks: dict[str, list[Group]]) -> dict[str, str]:
    found = {}
    for task, members in tasks.items():
        names = (name.replace(":", "-") for name in (task, members[0].rows[0].env))
        paths = (sweep.directory / "videos" / f"{name}.mp4" for name in names)
        if path := next((path for path in paths if path.is_file()), None):
            found[task] = _data_uri("video/mp4", path.read_bytes())
    return found


def _settings(groups: list[Group]) -> list[tuple[Group, Group, Table, set[str]]]:
    """Return each group with the first of its algorithm, its settings and those that differ."""
    firsts: dict[str, Group] = {}
    found = []
    for group in groups:
        first = firsts.setdefault(group.algo, group)
        ours, theirs = group.settings, first.settings
        differ = {name for name in ours if name not in theirs or theirs[name] != ours[name]}
        rows = [(name, shown(value)) for name, value in ours.items()]
        found.append((group, first, Table(("setting", "value"), rows, keys=1), differ))
    return found


def _versions(sweep: Sweep) -> Table:
    """Count the runs of each version, machine and revision."""
    facts = Counter(
        (name, NONE if value is None else str(value))
        for row in sweep.rows
        for name, value in {
            "git revision": row.git_revision,
            **{f"machine: {name}": value for name, value in row.machine.items()},
            **row.versions,
        }.items()
    )
    rows = [(*fact, str(count)) for fact, count in sorted(facts.items())]
    return Table(("name", "value", "runs"), rows)


def _some(names: Sequence[str], most: int = 10) -> str:
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest


def _svg_uri(figure: Figure) -> str:
    """Return a picture of its own, so that nothing in it meets the names of the page."""
    return _data_uri("image/svg+xml", figures.svg(figure))


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
