"""The files of a report: its figures, and one page of HTML from `templates/page.html`."""

import base64
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from dgae_jax.report import analysis, figures, tables
from dgae_jax.report.groups import Group, by_task, groups_of, shown
from dgae_jax.report.results import Published, Row, Sweep
from dgae_jax.report.tables import Table
from dgae_jax.run import files
from dgae_jax.run.terminal import counted


def write(sweeps: Sequence[Sweep], out: Path, published: Sequence[Published] = ()) -> list[Path]:
    """Write report.html and the figures of each sweep, and return the files.

    Args:
        sweeps: The sweeps; several are compared with the first.
        out: Directory, made if needed. With several sweeps, figures are numbered by sweep.
        published: Published results to draw.

    Raises:
        OSError: `out` cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for number, sweep in enumerate(sweeps, start=1):
        prefix = f"{number}-" if len(sweeps) > 1 else ""
        for name, figure in drawn(groups_of(sweep.rows), published):
            for kind in ("png", "svg"):
                written.append(out / f"{prefix}{name}.{kind}")
                files.replace(written[-1], figures.image(figure, kind))
    html = out / "report.html"
    files.replace(html, page(sweeps, published).encode())
    return [*written, html]


def drawn(groups: list[Group], published: Sequence[Published]) -> Iterator[tuple[str, Figure]]:
    """Yield the figures that the results of a sweep suffice for, by name."""
    yield "learning", figures.learning_curves(groups, published)
    yield "returns", figures.final_returns(groups)
    if found := analysis.improvements(groups):
        yield "improvement", figures.improvement(found)
    if analysis.normalised(groups):
        yield "profile", figures.performance_profile(groups)


def page(sweeps: Sequence[Sweep], published: Sequence[Published] = ()) -> str:
    """Return the page: a comparison with the first sweep if there are several, then each sweep."""
    environment = Environment(
        loader=PackageLoader("dgae_jax.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"counted": counted, "number": tables.number, "svg_uri": _svg_uri}
    template = environment.get_template("page.html")
    return template.render(
        sweeps=[(sweep, groups_of(sweep.rows)) for sweep in sweeps],
        published=published,
        analysis=analysis,
        by_task=by_task,
        figures=figures,
        settings=_settings,
        tables=tables,
        versions=_versions,
        videos=_videos,
    )


def _videos(sweep: Sweep, groups: Iterable[Group]) -> dict[str, str]:
    tasks, videos = by_task(groups), sweep.directory / "videos"
    paths = {task: videos / f"{task.replace(':', '-')}.mp4" for task in tasks}
    return {
        task: _data_uri("video/mp4", path.read_bytes())
        for task, path in paths.items()
        if path.is_file()
    }


def _settings(groups: list[Group]) -> list[tuple[Group, Group, Table, set[str]]]:
    """Return each group with the first of its algorithm, its settings and those that differ."""
    firsts: dict[str, Group] = {}
    found = []
    for group in groups:
        first = firsts.setdefault(group.algo, group)
        ours, theirs = group.rows[0].settings, first.rows[0].settings
        differ = {name for name in ours if name not in theirs or theirs[name] != ours[name]}
        rows = [(name, shown(value)) for name, value in ours.items()]
        found.append((group, first, Table(("setting", "value"), rows, keys=1), differ))
    return found


def _versions(rows: Iterable[Row]) -> Table:
    """Return the revisions, versions and machines of all runs."""
    facts = {
        (name, shown(value))
        for row in rows
        for name, value in {"git revision": row.git_revision, **row.versions, **row.machine}.items()
    }
    return Table(("name", "value"), sorted(facts), keys=1)


def _svg_uri(figure: Figure) -> str:
    """Return a picture of its own, so that nothing in it meets the names of the page."""
    return _data_uri("image/svg+xml", figures.image(figure, "svg"))


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
