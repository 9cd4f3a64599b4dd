"""The files of a report: figures and the page, in a directory of their own."""

import gc
from collections.abc import Iterator, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from dgae_jax.configs.config import invalid
from dgae_jax.report import analysis, figures
from dgae_jax.report.groups import Group, groups_of
from dgae_jax.report.page import page
from dgae_jax.report.published import Published
from dgae_jax.report.results import Study
from dgae_jax.run import files


def write(studies: Sequence[Study], out: Path, published: Sequence[Published] = ()) -> list[Path]:
    """Write report.html and each study's figures into `out`, which is made; the files in the order of writing.

    With several studies, the number of the study precedes the names of its figures. Raises ConfigError where `out` cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        written = []
        for number, study in enumerate(studies, start=1):
            prefix = f"{number}-" if len(studies) > 1 else ""
            for name, figure in drawn(groups_of(study.rows), published):
                written += figures.save(figure, out / (prefix + name))
        gc.collect()  # figures are full of reference cycles
        html = out / "report.html"
        files.replace(html, page(studies, published).encode())
    except OSError as reason:
        raise invalid(
            "out", out, f"a directory that can be written ({reason.strerror})"
        ) from reason
    return [*written, html]


def drawn(groups: list[Group], published: Sequence[Published]) -> Iterator[tuple[str, Figure]]:
    """The figures of one study that its results suffice for, by name."""
    yield "learning", figures.learning_curves(groups, published)
    yield "returns", figures.final_returns(groups)
    if found := analysis.improvements(groups):
        yield "improvement", figures.improvement(found)
    if analysis.normalised(groups):
        yield "profile", figures.performance_profile(groups)
    yield "speed", figures.speed(groups)
