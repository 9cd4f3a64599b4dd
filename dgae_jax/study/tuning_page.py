"""The page of a tuning: one file with the best settings, the trials in pictures, and words for those who cannot see them."""

import base64
import html
import io
from collections.abc import Callable
from typing import Any, NamedTuple

import matplotlib
import optuna
from matplotlib.ticker import MaxNLocator
from optuna.trial import FrozenTrial

from dgae_jax.run import files
from dgae_jax.run.options import engine_of
from dgae_jax.run.terminal import counted
from dgae_jax.study.search import Range
from dgae_jax.study.storage import unwarned
from dgae_jax.study.trials import finished
from dgae_jax.study.tuning import FIRST_SEED, Tuning

TARGET = "mean return"

STYLE = """
:root { color-scheme: light dark; --ink: #1a1a1a; --page: #fafafa; --card: #fff; --line: #d8d8d8 }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --page: #141414; --card: #1f1f1f; --line: #3a3a3a } }
body { font: 1rem/1.5 system-ui, sans-serif; color: var(--ink); background: var(--page); max-width: 46rem; margin: 0 auto; padding: 1rem }
section { background: var(--card); border: 1px solid var(--line); border-radius: .6rem; padding: .2rem 1rem 1rem; margin: 1rem 0 }
img { width: 100%; height: auto; background: #fff; border-radius: .4rem }
.scroll { overflow-x: auto } table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th, td { text-align: right; padding: .2rem .8rem .2rem 0; border-bottom: 1px solid var(--line); white-space: nowrap }
code { overflow-wrap: anywhere }
"""


class Picture(NamedTuple):
    """One of Optuna's plots."""

    title: str
    name: str
    """Of its file, without `.png`."""
    least: int
    """Trials that it takes."""
    draw: Callable[[Tuning, optuna.Study], Any]
    """Its axes."""
    words: Callable[[Tuning, optuna.Study, list[FrozenTrial]], str]
    """What it shows, in a sentence."""


def write(tuning: Tuning, study: optuna.Study, best: list[FrozenTrial]) -> None:
    """`tuning.html` and the PNGs in it; `best` are the trials that got to their end, the best first."""
    cards = ""
    for picture in PICTURES:
        alike = len({trial.value for trial in best}) < 2  # nothing explains a spread of zero
        if (
            len(best) < picture.least
            or (alike and picture.least > 1)
            or (picture is MAP and len(_pair(tuning)) < 2)
        ):
            continue
        image, words = (
            _png(lambda picture=picture: picture.draw(tuning, study)),
            html.escape(picture.words(tuning, study, best)),
        )
        files.replace(tuning.directory / f"{picture.name}.png", image)
        shown = (
            f'<img alt="{words}" src="data:image/png;base64,{base64.b64encode(image).decode()}">'
        )
        cards += f"<section><h2>{picture.title}</h2>{shown}<p>{words}</p></section>"
    files.replace(tuning.directory / "tuning.html", _page(tuning, study, best, cards).encode())


def _png(draw: Callable[[], Any]) -> bytes:
    """One of Optuna's plots, in sizes that a phone shows."""
    from matplotlib import pyplot

    image = io.BytesIO()
    with unwarned(), matplotlib.rc_context(), pyplot.style.context("default"):
        pyplot.switch_backend("agg")
        axes = draw()
        figure = axes.figure
        figure.set_size_inches(6.4, 4.2)
        figure.savefig(image, format="png", dpi=150, bbox_inches="tight")
        pyplot.close(figure)
    return image.getvalue()


def _history(tuning: Tuning, study: optuna.Study) -> Any:
    axes = optuna.visualization.matplotlib.plot_optimization_history(study, target_name=TARGET)
    axes.set(title="Return of each trial", xlabel="trial")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return axes


def _history_words(tuning: Tuning, study: optuna.Study, best: list[FrozenTrial]) -> str:
    ends = f"{best[0].value:,.1f} of trial {best[0].number}"
    return f"Dots: the {TARGET} of each of {len(best)} trials. Line: the best so far, at the end {ends}."


def _importances(tuning: Tuning, study: optuna.Study) -> Any:
    axes: Any = optuna.visualization.matplotlib.plot_param_importances(study, target_name=TARGET)
    axes.set_title("", loc="left")  # where Optuna has its own
    axes.set(title="How much of the spread each setting explains", xlabel="share", ylabel="")
    axes.get_legend().remove()  # its only entry is the share
    return axes


def _importances_words(tuning: Tuning, study: optuna.Study, best: list[FrozenTrial]) -> str:
    with unwarned():
        shares = optuna.importance.get_param_importances(study)
    return (
        "Share of each setting: "
        + ", ".join(f"{path} {share:.0%}" for path, share in shares.items())
        + "."
    )


def _map(tuning: Tuning, study: optuna.Study) -> Any:
    axes = optuna.visualization.matplotlib.plot_contour(
        study, params=_pair(tuning), target_name=TARGET
    )
    axes.set(title="Return between the trials")
    return axes


def _map_words(tuning: Tuning, study: optuna.Study, best: list[FrozenTrial]) -> str:
    one, two = _pair(tuning)
    at = f"{one} {best[0].params[one]:.5g} and {two} {best[0].params[two]:.5g}"
    return f"The {TARGET} over {one} and {two}, interpolated between the trials (dots); darker is better. The best is at {at}."


def _pair(tuning: Tuning) -> list[str]:
    """The two settings of the map: γ and λ where they are searched, the first two numbers otherwise."""
    if {"gamma", "lam"} <= set(tuning.space):
        return ["gamma", "lam"]
    return [path for path, dimension in tuning.space.items() if isinstance(dimension, Range)][:2]


MAP = Picture("Map", "contour", 4, _map, _map_words)
PICTURES = (
    Picture("Trials", "history", 1, _history, _history_words),
    Picture("Importance", "importances", 4, _importances, _importances_words),
    MAP,
)


def _page(tuning: Tuning, study: optuna.Study, best: list[FrozenTrial], cards: str) -> str:
    config, trials = tuning.config, finished(study)
    seeds = f"{tuning.seeds} seeds from {FIRST_SEED}" if tuning.seeds > 1 else f"seed {FIRST_SEED}"
    what = f"{config.task}, {config.algo} on {config.physics}: {len(trials)} trials of {config.total_steps:,} steps, {seeds}"
    searched = ", ".join(f"{path} {dimension}" for path, dimension in tuning.space.items())
    where, episodes = (
        engine_of(config, tuning.options.eval_engine),
        counted(tuning.options.episodes, "episode"),
    )
    measure = f"{TARGET} of {episodes} per seed in {where}, of the policy at the end"
    command = f"dgae train --config {tuning.directory / 'best.json'}"
    return (
        f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Tuning of {html.escape(config.task)} {html.escape(str(config.algo))}</title><style>{STYLE}</style>"
        f"<h1>Tuning of {html.escape(str(config.algo))} on {html.escape(config.task)}</h1><p>{html.escape(what)}; {html.escape(measure)}."
        f"</p><p>Searched: {html.escape(searched)}.</p><section><h2>Best trials</h2>{_table(tuning, best[:10])}"
        f"<p><code>{html.escape(command)}</code></p></section>{cards}</html>\n"
    )


def _table(tuning: Tuning, trials: list[FrozenTrial]) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in ("trial", TARGET, *tuning.space))
    rows = "".join(
        "<tr>"
        + "".join(
            f"<td>{html.escape(cell)}</td>"
            for cell in (str(t.number), f"{t.value:,.1f}", *_settings(tuning, t))
        )
        + "</tr>"
        for t in trials
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{rows}</table></div>'


def _settings(tuning: Tuning, trial: FrozenTrial) -> list[str]:
    values = [trial.params[path] for path in tuning.space]
    return [f"{value:.5g}" if isinstance(value, float) else str(value) for value in values]
