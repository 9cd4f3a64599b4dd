"""The outcome of a tuning: best.json, trials.csv, tuning.html and the best trials in print."""

import base64
import csv
import io
import warnings
from collections.abc import Callable
from typing import Any

import jinja2
import numpy as np
import optuna.visualization.matplotlib as plots
from matplotlib import pyplot
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from dgae_jax.configs.serial import to_dict
from dgae_jax.run import files, terminal
from dgae_jax.run.options import engine_of
from dgae_jax.study.search import Tuning

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


def finished(study: Study) -> list[FrozenTrial]:
    """Return the trials that were trained to their end or pruned."""
    return study.get_trials(deepcopy=False, states=FINISHED)


def say_new(study: Study, count: int) -> int:
    """Print the trials that finished after the first `count`, and return the new count."""
    trials = sorted(finished(study), key=lambda trial: str(trial.datetime_complete))
    for trial in trials[count:]:
        terminal.say(_line(trial))
    return len(trials)


def _line(trial: FrozenTrial) -> str:
    result = "none" if trial.value is None else f"{trial.value:,.1f}"
    values = {k: f"{v:.5g}" if isinstance(v, float) else v for k, v in trial.params.items()}
    settings = ", ".join(f"{path} {value}" for path, value in values.items())
    return f"trial {trial.number}: {trial.state.name.lower()}, return {result} ({settings})"


def write(tuning: Tuning, study: Study) -> int:
    """Write the files and print the best trials; return 1 if none was trained to its end."""
    trials, best_file = finished(study), tuning.directory / "best.json"
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["trial", "state", "return_mean", "seconds", *tuning.space])
    for trial in trials:
        seconds = trial.duration.total_seconds() if trial.duration else None
        values = map(trial.params.get, tuning.space)
        table.writerow([trial.number, trial.state.name.lower(), trial.value, seconds, *values])
    files.replace(tuning.directory / "trials.csv", text.getvalue().encode())
    best = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    if not best:
        log = f"{tuning.directory}/worker-*.log"
        terminal.warn(f"all {len(trials)} trials were pruned or diverged; see {log}")
        return 1
    best.sort(key=lambda trial: trial.value or 0.0, reverse=True)
    config = tuning.trial_config(best[0].params).as_config().replace(seed=0, num_seeds=1)
    files.write_json(best_file, to_dict(config))
    lines = [_line(trial) for trial in best[:10]]
    draws = [plots.plot_optimization_history, plots.plot_slice]
    if len({trial.value for trial in best}) >= 4:  # fewer explain no importance
        draws.append(plots.plot_param_importances)
    loader = jinja2.PackageLoader("dgae_jax.study")
    templates = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
    page = templates.get_template("tuning.html").render(
        tuning=tuning,
        engine=engine_of(tuning.config, tuning.options.eval_engine),
        trials=len(trials),
        best=lines,
        plots=[_png(study, draw) for draw in draws],
        best_file=best_file,
    )
    files.replace(tuning.directory / "tuning.html", page.encode())
    terminal.say(f"{len(best)} of {len(trials)} trials were trained to their end, the best are")
    terminal.say("\n".join(lines))
    terminal.say(f"train with the best settings: dgae train --config {best_file}")
    return 0


def _png(study: Study, draw: Callable[..., Any]) -> str:
    """Return one of Optuna's plots as base64."""
    image = io.BytesIO()
    pyplot.switch_backend("agg")
    with pyplot.style.context("default"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of experimental functions, and of axes without an extent
        figure = np.ravel(draw(study, target_name="mean return"))[0].figure
        figure.savefig(image, format="png", dpi=120, bbox_inches="tight")
        pyplot.close(figure)
    return base64.b64encode(image.getvalue()).decode()
