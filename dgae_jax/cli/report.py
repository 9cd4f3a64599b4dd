"""Report on sweeps: `dgae report SWEEP …`."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from dgae_jax.cli import parse
from dgae_jax.cli.export import RenderArguments, render
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.envs.registry import spec_of
from dgae_jax.report import results
from dgae_jax.report.results import Row, Sweep
from dgae_jax.run import terminal


@dataclass(frozen=True)
class Arguments:
    """Write figures, tables and one page of HTML from the results of sweeps."""

    sweeps: tyro.conf.Positional[tuple[Path, ...]]
    """Directories of sweeps, or files of results; several are compared with the first [paths]."""
    out: Path | None = None
    """Directory to write to; by default report in the directory of the first sweep [path]."""
    published: bool = False
    """Mark results that others have published in the learning curves."""
    videos: bool = False
    """Show a video per task, of the median seed of the best algorithm, kept in SWEEP/videos."""
    markdown: Path | None = None
    """A file in which tables between `<!-- dgae report: NAME -->` and `<!-- /dgae report -->` are
    replaced; `NAME of SWEEP` is a table that only a report on that sweep replaces [path]."""


@parse.command(Arguments)
def report(args: Arguments) -> None:
    """Write the tables of a document, videos, figures and the page."""
    if not args.sweeps:
        raise ConfigError("SWEEPS: must be the directory of one sweep or more")
    if args.markdown and len(args.sweeps) > 1:
        both = f"markdown {args.markdown}: cannot be combined with several sweeps"
        raise ConfigError(both, "markdown")
    sweeps = [results.read(path) for path in args.sweeps]
    out = args.out or sweeps[0].directory / "report"
    published = results.published() if args.published else []
    from dgae_jax.report import groups, page, tables

    if args.markdown:
        found = groups.groups_of(sweeps[0].rows)
        names = tables.replace(args.markdown, found, sweeps[0].name)
        terminal.say(f"written {args.markdown}: {', '.join(names)}")
    for sweep in sweeps if args.videos else ():
        _write_videos(sweep)
    with parse.writing(out, "directory"):
        for path in page.write(sweeps, out, published):
            terminal.say(f"written {path}")


def typical(rows: list[Row]) -> Row:
    """Return the median seed, the better of two, of the algorithm with the highest mean return."""
    returns: dict[str, list[float]] = {}
    for row in sorted(rows, key=lambda row: row.algo):
        returns.setdefault(row.algo, []).append(row.final)
    best = max(returns, key=lambda algo: sum(returns[algo]) / len(returns[algo]))
    ordered = sorted((row for row in rows if row.algo == best), key=lambda row: row.final)
    return ordered[len(ordered) // 2]


def _write_videos(sweep: Sweep) -> None:
    """Render the typical run of each task that has no video yet."""
    for task in dict.fromkeys(row.task for row in sweep.rows):
        rows = [row for row in sweep.rows if row.task == task]
        out = sweep.directory / "videos" / f"{task.replace(':', '-')}.mp4"
        if out.exists() or not spec_of(rows[0].env).eval_envs:
            continue
        chosen = typical(rows)
        run_dir = sweep.directory / "runs" / chosen.run
        if not run_dir.is_dir():
            raise invalid("videos", True, f"left out: the runs of {sweep.path} are not here")
        out.parent.mkdir(exist_ok=True)
        index = chosen.seed - int(chosen.config["seed"])
        render.work(RenderArguments(run_dir=run_dir, index=index, format="mp4", seconds=8, out=out))
