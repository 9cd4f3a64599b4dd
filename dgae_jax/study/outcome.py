"""The outcome of a tuning: best.json, trials.csv, tuning.html and a printed table."""

import base64
import csv
import io
import warnings
from collections.abc import Callable
from typing import Any

import jinja2
import optuna.visualization.matplotlib as plots
from matplotlib import pyplot
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from dgae_jax.configs.serial import to_dict
from dgae_jax.run import files, terminal
from dgae_jax.run.options import engine_of
from dgae_jax.study.search import FIRST_SEED, Tuning, shown

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)

TOP = 10
"""Trials that are printed."""

_TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("dgae_jax.study"), autoescape=True, trim_blocks=True
)


PLOTS: dict[str, tuple[Callable[..., Any], int]] = {
    "Return of each trial, and the best so far": (plots.plot_optimization_history, 1),
    "Share of the spread that each setting explains": (plots.plot_param_importances, 4),
    "Return by setting": (plots.plot_slice, 1),
}
"""By title: Optuna's function, and the number of different returns that it needs."""


def settings_of(trial: FrozenTrial) -> dict[str, str]:
    """Return the values of a trial as they are printed."""
    return {
        path: f"{value:.5g}" if isinstance(value, float) else str(value)
        for path, value in trial.params.items()
    }


def write(tuning: Tuning, study: Study) -> int:
    """Write the files and print the best trials; return 1 if none was trained to its end."""
    trials, best_file = study.get_trials(states=FINISHED), tuning.directory / "best.json"
    files.replace(tuning.directory / "trials.csv", _csv(tuning, trials))
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    best = sorted(complete, key=lambda trial: (-(trial.value or 0.0), trial.number))
    if not best:
        log = f"{tuning.directory}/worker-*.log"
        terminal.warn(f"all {len(trials)} trials were pruned or diverged; see {log}")
        return 1
    files.write_json(best_file, to_dict(tuning.best_config(best[0].params)))
    table = [["trial", "return", *tuning.space]]
    for trial in best[:TOP]:
        settings = settings_of(trial)
        values = (settings[path] for path in tuning.space)
        table.append([str(trial.number), f"{trial.value:,.1f}", *values])
    count = len({trial.value for trial in best})
    page = _TEMPLATES.get_template("tuning.html").render(
        tuning=tuning,
        first_seed=FIRST_SEED,
        trials=len(trials),
        search={path: shown(each) for path, each in tuning.space.items()},
        engine=engine_of(tuning.config, tuning.options.eval_engine),
        table=table,
        plots={
            title: _png(study, draw) for title, (draw, least) in PLOTS.items() if count >= least
        },
        best=best_file,
    )
    files.replace(tuning.directory / "tuning.html", page.encode())
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        terminal.say("  ".join(map(str.rjust, row, widths)))
    where = f"all of them in {tuning.directory / 'trials.csv'}, plots in tuning.html"
    terminal.say(f"{len(trials)} trials, {len(trials) - len(best)} of them pruned; {where}")
    terminal.say(f"train with the best settings: dgae train --config {best_file}")
    return 0


def _csv(tuning: Tuning, trials: list[FrozenTrial]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["trial", "state", "return_mean", "seconds", *tuning.space])
    for trial in trials:
        seconds = trial.duration.total_seconds() if trial.duration else None
        values = (trial.params.get(path) for path in tuning.space)
        writer.writerow([trial.number, trial.state.name.lower(), trial.value, seconds, *values])
    return text.getvalue().encode()


def _png(study: Study, draw: Callable[..., Any]) -> str:
    """Return one of Optuna's plots as base64."""
    image = io.BytesIO()
    pyplot.switch_backend("agg")
    with pyplot.style.context("default"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of experimental functions, and of axes without an extent
        axes = draw(study, target_name="mean return")
        figure = (axes if hasattr(axes, "figure") else axes.flat[0]).figure
        figure.savefig(image, format="png", dpi=120, bbox_inches="tight")
        pyplot.close(figure)
    return base64.b64encode(image.getvalue()).decode()
