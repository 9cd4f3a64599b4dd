"""A tuning: an Optuna study of training runs, shared by processes and machines.

The study is DIRECTORY/optuna.db or in PostgreSQL; the run of each trial is DIRECTORY/trials/NUMBER.
Optuna's messages are in DIRECTORY/worker-N.log.
"""

import base64
import contextlib
import csv
import io
import json
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jinja2
import numpy as np
import optuna
import optuna.visualization.matplotlib as plots
import sqlalchemy.exc
from matplotlib import pyplot
from optuna.distributions import CategoricalDistribution, IntDistribution
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial, TrialState

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.serial import to_dict
from dgae_jax.run import directory, files, terminal, training
from dgae_jax.run.options import engine_of
from dgae_jax.run.runtime import Signals
from dgae_jax.run.terminal import Reporter
from dgae_jax.run.training import DivergedError, RunError
from dgae_jax.study.launch import local
from dgae_jax.study.search import Tuning, Values
from dgae_jax.study.worker import Job

QUARTERS = 4
"""Parts of a trial; at the end of each but the last a trial worse than the median is pruned."""

POLL = 0.5
"""Time between looks at the study [s]."""

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


def finished(study: Study) -> list[FrozenTrial]:
    """Return the trials that were trained to their end or pruned."""
    return study.get_trials(deepcopy=False, states=FINISHED)


def tune(tuning: Tuning) -> int:
    """Finish the trials of a tuning, together with all processes that share it.

    Returns:
        The exit code: 0 done, 1 trials are missing or none was trained to its end, 128 + a signal
        that stopped it.

    Raises:
        ConfigError: the directory or the database cannot be used, or tunes something else.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with directory.must_be("a directory that can be written", tuning.directory, "study"):
        (tuning.directory / "trials").mkdir(parents=True, exist_ok=True)
        study = open_study(tuning)
        workers = range(min(tuning.workers, tuning.trials - len(finished(study))))
        logs = [tuning.directory / f"worker-{i}.log" for i in workers]
        jobs = [Job(log.stem, work, (tuning, i), log) for i, log in enumerate(logs)]
        with Signals() as signals, Reporter() as reporter, local(jobs, tuning.workers) as tasks:
            while not signals.received and not all(task.done() for task in tasks):
                time.sleep(POLL)
                reporter.watch(f"{len(finished(study))} of {tuning.trials} trials are finished")
        if len(finished(study)) < tuning.trials:
            how = f"by {signals.received.name}" if signals.received else f"early, see {logs[0]}"
            terminal.say(f"stopped {how}; the same command continues")
            return 128 + signals.received if signals.received else 1
        return write_outcome(tuning, study)


def open_study(tuning: Tuning, worker: int = 0) -> Study:
    """Open the study of a tuning, or create it with the configuration's own values as a trial.

    Raises:
        ConfigError: the database cannot be reached, or the study tunes something else.
    """
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    # SQLite has one writer at a time; others wait for up to a minute
    url = tuning.storage or f"sqlite:///{tuning.directory.absolute() / 'optuna.db'}?timeout=60"
    try:
        study = optuna.create_study(
            storage=optuna.storages.RDBStorage(
                url,
                heartbeat_interval=30,  # a trial without one for twice as long [s] is retried
                heartbeat_stale_trial_callback=_retry,
            ),
            study_name=tuning.directory.absolute().name,
            direction="maximize",
            load_if_exists=True,
            pruner=optuna.pruners.MedianPruner(),
        )
    except (sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.OptunaError) as reason:
        why = str(getattr(reason, "orig", None) or reason).partition("\n")[0]
        # the address may have a password
        raise ConfigError(f"storage: must be a database that answers ({why})", "storage") from None
    engine = engine_of(tuning.config, tuning.options.eval_engine)
    shared = [str(tuning.space), tuning.seeds, tuning.options.episodes, engine]
    ours = json.dumps([to_dict(tuning.config), *shared], sort_keys=True)
    if study.user_attrs.get("tuning", ours) != ours:
        allowed = "new, or of the same settings, search, seeds, episodes and evaluation engine"
        raise invalid("study", tuning.directory, allowed)
    study.set_user_attr("tuning", ours)
    count = len(study.get_trials(deepcopy=False))
    if not count:
        with contextlib.suppress(ValueError):  # one of the values is outside the space
            start = tuning.start_values()
            optuna.create_trial(params=start, distributions={**tuning.space}, value=0.0)
            study.enqueue_trial(start, skip_if_exists=True)
    # a worker that continues draws other numbers than it drew before
    entropy = np.random.SeedSequence((tuning.sampler_seed, worker, count))
    study.sampler = optuna.samplers.TPESampler(seed=int(entropy.generate_state(1)[0]))
    return study


def _retry(study: Study, trial: FrozenTrial) -> None:
    """Enqueue a trial again, unless its settings seem to kill it."""
    optuna.storages.RetryHeartbeatStaleTrialCallback(max_retry=5)(study, trial)


def work(tuning: Tuning, number: int = 0) -> int:
    """Train trials until enough are finished, here or elsewhere; return the exit code."""
    # a fault of the machine must not count against the settings of a trial
    training.prepare(replace(tuning.config, num_seeds=tuning.seeds), tuning.options)
    study = open_study(tuning, 1 + number)
    while len(finished(study)) < tuning.trials:
        optuna.storages.fail_stale_trials(study)
        taken = study.get_trials(deepcopy=False, states=(*FINISHED, TrialState.RUNNING))
        # a trial that was taken but has no values lost its process before its first heartbeat
        if sum(bool(trial.params) for trial in taken) < tuning.trials:
            try:
                study.optimize(partial(_train, tuning, study), n_trials=1)
            except RunError as end:
                terminal.say(str(end))
                return end.exit_code
        else:
            time.sleep(POLL)
    return 0


def _suggest(trial: Trial, path: str, values: Values) -> Any:
    if isinstance(values, CategoricalDistribution):
        return trial.suggest_categorical(path, values.choices)
    suggest: Any = trial.suggest_int if isinstance(values, IntDistribution) else trial.suggest_float
    return suggest(path, values.low, values.high, log=values.log)


def _train(tuning: Tuning, study: Study, trial: Trial) -> float:
    """Train a trial in its run directory; one that a signal or a fault stops is tried again."""
    values = {path: _suggest(trial, path, each) for path, each in tuning.space.items()}
    number = trial.user_attrs.get("run", trial.number)  # a retry has the attributes of the trial
    trial.set_user_attr("run", number)
    try:
        config = tuning.trial_config(values)
        every = -(-config.iterations // QUARTERS) * config.samples_per_iteration
        options = replace(
            tuning.options,
            run_dir=tuning.directory / "trials" / f"{number:04d}",
            resume_or_start=True,
            inexact=True,
            checkpoint_every=every,
            keep_checkpoints=1,
        )
        training.prepare(config, options)
    except ConfigError as reason:
        raise optuna.TrialPruned from reason

    def report(steps: int, result: dict[str, Any]) -> None:
        trial.report(result["return_mean"], steps // every)
        if trial.should_prune():
            raise optuna.TrialPruned

    try:
        evaluation, _ = training.train(config, options, report)
    except DivergedError as reason:
        raise optuna.TrialPruned from reason
    except RunError:
        _retry(study, study.trials[trial.number])
        raise
    if not math.isfinite(evaluation["return_mean"]):
        raise optuna.TrialPruned
    return evaluation["return_mean"]


def write_outcome(tuning: Tuning, study: Study) -> int:
    """Write trials.csv, best.json and tuning.html; return 1 if no trial was trained to its end."""
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
        terminal.warn(f"all {len(trials)} trials were pruned or diverged; see worker-*.log")
        return 1
    best.sort(key=lambda trial: trial.value or 0.0, reverse=True)
    config = tuning.trial_config(best[0].params).as_config().replace(seed=0, num_seeds=1)
    files.write_json(best_file, to_dict(config))
    lines = [f"trial {t.number}: return {t.value:,.1f} with {t.params}" for t in best[:10]]
    draws = (plots.plot_optimization_history, plots.plot_slice, plots.plot_param_importances)
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
