"""What comes of a tuning: a line for each trial, the best settings, a table, a page."""

import csv
import io
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from dgae_jax.configs.serial import to_dict
from dgae_jax.run import files, terminal
from dgae_jax.study.trials import finished
from dgae_jax.study.tuning import Tuning

TOP = 10
"""Trials that are printed."""

WIDTH = 80
"""Of what is printed [characters]."""


class Progress:
    """Says once of every trial that it finished, whoever trained it."""

    def __init__(self, study: optuna.Study):
        self.study = study
        self.said = {trial.number for trial in finished(study)}
        if self.said:
            terminal.say(f"going on after {len(self.said)} finished trials")

    def show(self) -> None:
        """A line for each trial that has finished since."""
        new = [trial for trial in finished(self.study) if trial.number not in self.said]
        for trial in sorted(new, key=lambda trial: (trial.datetime_complete, trial.number)):
            self.said.add(trial.number)
            best = ranked([t for t in finished(self.study) if t.number in self.said])[:1]
            leader = f"; best {best[0].value:,.1f} of trial {best[0].number}" if best else ""
            settings = ", ".join(f"{path} {_short(value)}" for path, value in trial.params.items())
            terminal.say(f"trial {trial.number}: {_worth(trial)} ({settings}){leader}")


def ranked(trials: list[FrozenTrial]) -> list[FrozenTrial]:
    """Those that got to their end, the best first."""
    return sorted(
        (t for t in trials if t.state == TrialState.COMPLETE), key=lambda t: (-_value(t), t.number)
    )


def _value(trial: FrozenTrial) -> float:
    assert trial.value is not None
    return trial.value


def _worth(trial: FrozenTrial) -> str:
    if trial.state == TrialState.COMPLETE:
        return f"return {trial.value:,.1f}"
    return "pruned" + (f" at {trial.value:,.1f}" if trial.value is not None else "")


def _short(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def write(tuning: Tuning, study: optuna.Study) -> int:
    """Write `best.json`, `trials.csv` and `tuning.html`, and print the best; 1 if no trial got to its end."""
    from dgae_jax.study import tuning_page

    trials = finished(study)
    files.replace(tuning.directory / "trials.csv", _csv(tuning, trials))
    best = ranked(trials)
    if not best:
        terminal.warn(
            f"no trial got to its end: all {len(trials)} were pruned or broke down; see {tuning.directory}/worker-*.log"
        )
        return 1
    files.write_json(tuning.directory / "best.json", to_dict(tuning.best(best[0].params)))
    tuning_page.write(tuning, study, best)
    terminal.say(table(tuning, best[:TOP]))
    pruned = len(trials) - len(best)
    terminal.say(
        f"{len(trials)} trials, {pruned} of them pruned; all of them in {tuning.directory / 'trials.csv'}, plots in tuning.html"
    )
    terminal.say(
        f"train with the best settings: dgae train --config {tuning.directory / 'best.json'}"
    )
    return 0


def _csv(tuning: Tuning, trials: list[FrozenTrial]) -> bytes:
    """All trials, in the order in which they were taken."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["trial", "state", "return_mean", "seconds", *tuning.space])
    for trial in trials:
        seconds = trial.duration.total_seconds() if trial.duration else None
        writer.writerow(
            [
                trial.number,
                trial.state.name.lower(),
                trial.value,
                seconds,
                *(trial.params.get(path) for path in tuning.space),
            ]
        )
    return text.getvalue().encode()


def table(tuning: Tuning, trials: list[FrozenTrial]) -> str:
    """Trials as aligned lines; where many settings are searched, the last ones do not fit."""
    rows = [["trial", "return", *tuning.space]]
    rows += [
        [str(t.number), f"{_value(t):,.1f}", *(_short(t.params[path]) for path in tuning.space)]
        for t in trials
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    fit = sum(1 for i in range(len(widths)) if sum(widths[: i + 1]) + 2 * i <= WIDTH)
    return "\n".join(
        "  ".join(text.rjust(width) for text, width in zip(row[:fit], widths[:fit], strict=True))
        for row in rows
    )
