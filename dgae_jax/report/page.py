"""The page: everything that is known of one or more studies, in one file that needs no other."""

from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import NamedTuple

from dgae_jax.report import analysis, figures, html, settings, tables
from dgae_jax.report.deviations import deviations
from dgae_jax.report.groups import Group, by_task, groups_of
from dgae_jax.report.published import Published
from dgae_jax.report.results import Study
from dgae_jax.run.terminal import counted


class Content(NamedTuple):
    """What the parts of a page are made from."""

    study: Study
    groups: list[Group]
    published: Sequence[Published]

    @property
    def tasks(self) -> dict[str, list[Group]]:
        """The groups of each task."""
        return by_task(self.groups)


def page(studies: Sequence[Study], published: Sequence[Published] = ()) -> str:
    """One page of HTML: the comparison with the first study where there are several, then each study in full."""
    contents = [Content(study, groups_of(study.rows), published) for study in studies]
    title = " and ".join(study.name for study in studies)
    several = len(contents) > 1
    links, body = [], [_compared(contents)] if several else []
    for number, content in enumerate(contents):
        prefix = f"s{number}-" if several else ""
        if several:
            body.append(html.heading(2, content.study.name, f"s{number}"))
            links.append((content.study.name, f"s{number}"))
        body.append(html.paragraph(_summary(content)))
        for name, part in PARTS.items():
            inside = part(content)
            anchor = prefix + name.lower().replace(" ", "-")
            if inside:
                body.append(html.heading(3 if several else 2, name, anchor) + inside)
                links += [] if several else [(name, anchor)]
    body.append(
        html.heading(2, "Deviations from the paper", "deviations")
        + html.listing(deviations(), ordered=True)
    )
    links = [
        *([("Comparison", "comparison")] if several else []),
        *links,
        ("Deviations from the paper", "deviations"),
    ]
    top = html.heading(1, title, "top") + html.navigation(links)
    return html.document(
        title, files("dgae_jax.report").joinpath("page.css").read_text(), "\n".join([top, *body])
    )


def _compared(contents: Sequence[Content]) -> str:
    first = contents[0]
    pieces = [html.heading(2, "Comparison", "comparison")]
    for other in contents[1:]:
        names = (first.study.name, other.study.name)
        pieces.append(html.table(tables.comparison(first.groups, other.groups, names)))
    note = "Interquartile means of the final returns and their difference, second minus first, with 95 % bootstrap intervals."
    return "".join([*pieces, html.paragraph(note, "note")])


def _summary(content: Content) -> str:
    rows, diverged = (
        content.study.rows,
        [f"seed {seed} of {cell}" for cell, seed in content.study.diverged],
    )
    seeds, steps = len({row.seed for row in rows}), sorted({row.total_steps for row in rows})
    budget = f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}"
    counts = {
        "task": len(content.tasks),
        "algorithm": len({group.algo for group in content.groups}),
        "seed": seeds,
    }
    told = ", ".join(counted(number, noun) for noun, number in counts.items())
    text = f"{counted(len(rows), 'trained run')}: {told}, {budget} environment steps each."
    return (
        text
        + _named("Cells without a result", content.study.missing)
        + _named("Left out, because their return is not finite", diverged)
    )


def _named(what: str, names: Sequence[str], most: int = 10) -> str:
    some = ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
    return f" {what}: {some}." if names else ""


def _returns(content: Content) -> str:
    pictures = [
        html.picture(
            figures.svg(figures.final_returns(members)),
            f"Final returns on {task}: {_said(members)}.",
        )
        for task, members in content.tasks.items()
    ]
    engines = " and ".join(sorted({row.engine for row in content.study.rows}))
    note = (
        f"Mean return of the last deterministic policy, evaluated in {engines}: mean ± sample standard deviation over seeds, and the"
        " interquartile mean (IQM) with its 95 % interval by the stratified bootstrap. Best checkpoint: mean ± deviation of the best of"
        " each seed's evaluations along the way, which are chosen by what they are judged by. In the pictures the dot is the IQM, the"
        " bar its interval, ticks are seeds; dots of scalar critics are hollow."
    )
    return html.table(tables.returns(content.groups)) + html.gallery(pictures, note)


def _said(members: Sequence[Group]) -> str:
    return ", ".join(f"{group.name} {group.finals.mean():,.0f}" for group in members)


def _curves(content: Content) -> str:
    pictures = []
    for task, members in content.tasks.items():
        ends = [(group.name, group.curve[1]) for group in members]
        said = ", ".join(f"{name} {curve[:, -1].mean():,.0f}" for name, curve in ends if curve.size)
        figure = figures.learning_curves(members, content.published)
        alt = f"Learning curves on {task}; mean return at the end of training: {said or 'none'}."
        pictures.append(html.picture(figures.svg(figure), alt))
    note = (
        "Undiscounted episode return while training, mean and standard deviation over seeds. Solid: with a value distribution; dashed: with"
        " a scalar critic."
        + (
            " Crosses are published results, beside their number of samples."
            if content.published
            else ""
        )
    )
    known = [
        one for one in content.published if one.task in {row.env for row in content.study.rows}
    ]
    sources = html.details("Published results", html.table(tables.others(known))) if known else ""
    return html.gallery(pictures, note) + sources


def _improvement(content: Content) -> str:
    found = analysis.improvements(content.groups)
    if not found:
        return ""
    said = "; ".join(
        f"{duel.better.name} over {duel.worse.name} on {duel.task} {duel.estimate.value:.2f}"
        for duel in found
    )
    note = "Probability that a seed of the first scores a higher final return than one of the second, ties counted half; 0.5 is no difference."
    picture = html.picture(
        figures.svg(figures.improvement(found)), f"Probability of improvement: {said}."
    )
    return html.table(tables.improvement(found)) + html.gallery([picture], note)


def _profile(content: Content) -> str:
    scores = analysis.normalised(content.groups)
    if not scores:
        return ""
    runs = ", ".join(
        f"{name} {counted(sum(map(len, strata)), 'run')} of {counted(len(strata), 'task')}"
        for name, (_, strata) in scores.items()
    )
    note = f"Share of runs whose final return, over the best mean of the task, is above τ; the shade is its 95 % interval. {runs}."
    alt = f"Performance profiles of {', '.join(scores)}."
    return html.gallery(
        [html.picture(figures.svg(figures.performance_profile(content.groups)), alt)], note
    )


def _reach(content: Content) -> str:
    note = "Samples after which the mean over seeds of the training return reaches a share of the task's highest mean; – where it does not."
    return html.table(tables.reach(content.groups)) + html.paragraph(note, "note")


def _speed(content: Content) -> str:
    pictures = []
    for task, members in content.tasks.items():
        said = ", ".join(
            f"{group.name} {sum(row.samples_per_second for row in group.rows) / len(group.rows):,.0f}"
            for group in members
        )
        pictures.append(
            html.picture(
                figures.svg(figures.speed(members)), f"Samples per second on {task}: {said}."
            )
        )
    note = "Samples per second and seconds of wall-clock time of a run; a tick per seed. Runs that share a machine slow each other down."
    return html.table(tables.speed(content.groups)) + html.gallery(pictures, note)


def _videos(content: Content) -> str:
    films = []
    for task, members in content.tasks.items():
        for name in (task, members[0].rows[0].env):
            path = content.study.directory / "videos" / f"{name.replace(':', '-')}.mp4"
            if path.is_file():
                films.append(
                    f"<div>{html.paragraph(task)}{html.video(path.read_bytes(), f'A trained policy on {task}')}</div>"
                )
                break
    return html.gallery(films, "Trained policies.") if films else ""


def _made(content: Content) -> str:
    return (
        settings.cells(content.groups)
        + settings.commands(content.groups)
        + settings.provenance(content.study.rows)
    )


PARTS: dict[str, Callable[[Content], str]] = {
    "Final returns": _returns,
    "Learning curves": _curves,
    "Probability of improvement": _improvement,
    "Performance profile": _profile,
    "Samples to reach a return": _reach,
    "Speed": _speed,
    "Videos": _videos,
    "How it was made": _made,
}
"""The parts of a study's report in their order; one that has nothing to say is left out."""
