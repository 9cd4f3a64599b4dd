"""Report on studies: dgae report STUDY …

Flags are checked before the rest is imported: Matplotlib takes a second to load.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from dgae_jax.cli.arguments import fail, parse, stopped
from dgae_jax.cli.source import check_directory
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.run import terminal

PURPOSE = "Figures, tables and one page of HTML from the results of studies."

EXAMPLES = (
    "dgae report studies/tuned",
    "dgae report studies/tuned studies/wide --out comparison",
    "dgae report studies/tuned --published --videos",
)


@dataclass(frozen=True)
class Arguments:
    """What to report on, and where to write it."""

    studies: tyro.conf.Positional[tuple[Path, ...]]
    """Directories of studies, or files of their results; several are compared with the first [paths]."""
    out: Path | None = None
    """Directory to write to; by default report in the directory of the first study [path]."""
    published: bool = False
    """Mark results that others have published in the learning curves."""
    videos: bool = False
    """Film a typical run of each task for the page: of the best algorithm, the seed in the middle; they stay in STUDY/videos."""
    markdown: Path | None = None
    """A Markdown file in which the tables between `<!-- dgae report: NAME -->` and `<!-- /dgae report -->` are replaced; NAME is
    returns, improvement, attribution, attribution-over-tasks, risk, reach or speed, and NAME of STUDY a table that only a report on
    that study replaces [path]."""


def main() -> int:
    """Write a report; 0 done, 2 bad input, 130 stopped by SIGINT."""
    terminal.prepare()
    try:
        return _report(parse(Arguments, PURPOSE, examples=EXAMPLES))
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT, the report is not complete")


def _report(arguments: Arguments) -> int:
    """Everything that can be wrong is looked at before the first file is written."""
    from dgae_jax.report import results

    if not arguments.studies:
        raise ConfigError(
            "STUDIES: must be the directory of one study or more (--help lists every flag)"
        )
    if arguments.markdown and len(arguments.studies) > 1:
        raise invalid("markdown", arguments.markdown, "left out where several studies are compared")
    studies = [results.read(path) for path in arguments.studies]
    out = arguments.out or studies[0].directory / "report"
    check_directory(out)
    known = results.published() if arguments.published else []
    from dgae_jax.cli import films
    from dgae_jax.report import groups, markdown, page

    if arguments.markdown:
        markdown.check(arguments.markdown, studies[0].name)
    if arguments.videos:
        for path in (path for study in studies for path in films.make(study)):
            terminal.say(f"written {path}")
    for path in page.write(studies, out, known):
        terminal.say(f"written {path}")
    if arguments.markdown:
        names = markdown.replace(
            arguments.markdown, groups.groups_of(studies[0].rows), studies[0].name
        )
        terminal.say(f"written {arguments.markdown}: {', '.join(names)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
