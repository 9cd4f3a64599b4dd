"""A tuning: an Optuna study of training runs, shared by processes and machines.

DIRECTORY/optuna.db          the study, unless it is in PostgreSQL
DIRECTORY/trials/NUMBER/     the run of each trial
DIRECTORY/worker-NUMBER.log  output of each process
DIRECTORY/best.json, trials.csv, tuning.html   the outcome
"""

import json
import math
import multiprocessing
import os
import signal
import sys
import time
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import optuna
import sqlalchemy.exc
from optuna.distributions import CategoricalDistribution, IntDistribution
from optuna.exceptions import ExperimentalWarning
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.study import MaxTrialsCallback, Study
from optuna.trial import FrozenTrial, Trial, TrialState

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.serial import flat, to_dict
from dgae_jax.run import files, terminal, training
from dgae_jax.run.options import engine_of
from dgae_jax.run.runtime import Signals
from dgae_jax.run.training import DivergedError, RunError
from dgae_jax.study import outcome
from dgae_jax.study.outcome import FINISHED
from dgae_jax.study.search import Distribution, Tuning, shown

UNDER_WAY = (*FINISHED, TrialState.RUNNING)

QUARTERS = 4
"""Parts of a trial; at the end of each but the last a trial worse than the median is pruned."""

MAX_RETRIES = 5
"""Retries of a trial after its process is lost, perhaps because of its settings."""

LOCK_TIMEOUT = 60
"""Longest wait for another process that writes to the same SQLite file [s]."""

SPAWN = multiprocessing.get_context("spawn")

POLL = 0.5
"""Time between looks at the study and the workers [s]."""


def tune(tuning: Tuning) -> int:
    """Finish the trials of a tuning, together with all processes that share it.

    Args:
        tuning: what is searched and where. If it was begun before, it continues.

    Returns:
        The exit code: 0 done, 1 trials are missing, 128 + a signal that stopped it.

    Raises:
        ConfigError: the directory or the database cannot be used, or tunes something else.
    """
    try:
        (tuning.directory / "trials").mkdir(parents=True, exist_ok=True)
        with warnings.catch_warnings(), Signals() as signals:
            warnings.simplefilter("ignore", ExperimentalWarning)
            study = open_study(tuning)
            _run_workers(tuning, study, signals)
            count = _count(study, FINISHED)
            if count < tuning.trials:
                by = f" by {signals.name}" if signals.received else ""
                left = f"{count} of {tuning.trials} trials are finished"
                terminal.say(f"stopped{by}: {left}; the same command continues")
                return signals.exit_code if signals.received else 1
            with files.turn(tuning.directory):
                return outcome.write(tuning, study)
    except OSError as reason:
        allowed = f"a directory that can be written ({reason.strerror})"
        raise invalid("study", tuning.directory, allowed) from reason


def open_study(tuning: Tuning, worker: int = 0) -> Study:
    """Open the study of a tuning, or create it with the configuration's own values as a trial.

    Raises:
        ConfigError: the database cannot be reached, or the study tunes something else.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    url = tuning.storage or f"sqlite:///{tuning.directory.absolute() / 'optuna.db'}"
    try:
        storage = RDBStorage(
            url,
            engine_kwargs={} if tuning.storage else {"connect_args": {"timeout": LOCK_TIMEOUT}},
            heartbeat_interval=tuning.heartbeat,
            grace_period=3 * tuning.heartbeat,
            heartbeat_stale_trial_callback=_retry,
        )
        study = optuna.create_study(
            storage=storage,
            study_name=tuning.directory.absolute().name,
            direction="maximize",
            load_if_exists=True,
            pruner=optuna.pruners.MedianPruner(),
        )
    except (sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.OptunaError) as reason:
        without_password = sqlalchemy.engine.make_url(url).render_as_string(hide_password=True)
        why = str(getattr(reason, "orig", None) or reason).partition("\n")[0]
        allowed = f"a database that can be reached ({why})"
        raise invalid("storage", without_password, allowed) from reason
    _check_same(study, tuning)
    count = len(study.get_trials(deepcopy=False))
    if not count and (start := tuning.start_values()):
        study.enqueue_trial(start, skip_if_exists=True)
    # a worker that continues draws other numbers than it drew before
    entropy = np.random.SeedSequence((tuning.sampler_seed, worker, count))
    study.sampler = optuna.samplers.TPESampler(seed=int(entropy.generate_state(1)[0]))
    return study


def _retry(study: Study, trial: FrozenTrial) -> None:
    """Enqueue a trial again, with what it has reported."""
    RetryHeartbeatStaleTrialCallback(MAX_RETRIES, inherit_intermediate_values=True)(study, trial)


def _check_same(study: Study, tuning: Tuning) -> None:
    """Write what is tuned, or refuse to tune anything else in this study."""
    ours = {
        **flat(json.loads(json.dumps(to_dict(tuning.config)))),
        **{f"search {path}": shown(each) for path, each in tuning.space.items()},
        "tuning_seeds": tuning.seeds,
        "episodes": tuning.options.episodes,
        "eval_engine": engine_of(tuning.config, tuning.options.eval_engine),
    }
    theirs = study.user_attrs.get("tuning")
    if theirs is None:
        study.set_user_attr("tuning", ours)
    elif theirs != ours:
        name = next(name for name in {**ours, **theirs} if ours.get(name) != theirs.get(name))
        allowed = f"{theirs.get(name)} as in {tuning.directory}, or with another --study"
        raise invalid(name, ours.get(name), allowed)


def _run_workers(tuning: Tuning, study: Study, signals: Signals) -> None:
    """Run processes until enough trials are finished, all of them fail or a signal came."""
    said = {trial.number for trial in study.get_trials(states=FINISHED)}
    while not signals.received and _count(study, FINISHED) < tuning.trials:
        optuna.storages.fail_stale_trials(study)
        missing = tuning.trials - _count(study, UNDER_WAY)
        workers = [
            SPAWN.Process(target=run_worker, args=(tuning, number))
            for number in range(min(missing, tuning.workers))
        ]
        for worker in workers:
            worker.start()
        is_told = False
        while running := [worker for worker in workers if worker.is_alive()]:
            if signals.received and not is_told:
                is_told = True
                for worker in running:
                    os.kill(worker.pid or 0, signals.received)
            _say_finished(study, said)
            time.sleep(POLL)
        for number, worker in enumerate(workers):
            if worker.exitcode and not signals.received:
                log = f"{tuning.directory}/worker-{number}.log"
                terminal.warn(f"worker {number} ended with exit code {worker.exitcode}, see {log}")
        if workers and all(worker.exitcode for worker in workers):
            break
        time.sleep(POLL)  # other machines may be at work on the last trials
        _say_finished(study, said)


def _count(study: Study, states: tuple[TrialState, ...]) -> int:
    return len(study.get_trials(deepcopy=False, states=states))


def _say_finished(study: Study, said: set[int]) -> None:
    for trial in study.get_trials(deepcopy=False, states=FINISHED):
        if trial.number not in said:
            said.add(trial.number)
            value = "no return" if trial.value is None else f"return {trial.value:,.1f}"
            settings = ", ".join(f"{path} {x}" for path, x in outcome.settings_of(trial).items())
            terminal.say(f"trial {trial.number}: {trial.state.name.lower()}, {value} ({settings})")


def run_worker(tuning: Tuning, number: int) -> None:
    """Train trials in this process, on every `tuning.workers`-th core, and end it."""
    os.setpgid(0, 0)  # Ctrl-C reaches the first process only, which passes it on once
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # outside of a run there is nothing to save
    if hasattr(os, "sched_getaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, cores[number :: tuning.workers])
    with (tuning.directory / f"worker-{number}.log").open("ab") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    terminal.prepare()
    code = work(tuning, number)
    sys.stdout.flush()
    os._exit(code)  # without waiting for a compiler that was broken off


def work(tuning: Tuning, number: int = 0) -> int:
    """Train trials until enough are under way; return the exit code."""
    warnings.simplefilter("ignore", ExperimentalWarning)
    warnings.filterwarnings("ignore", "The reported value is ignored")  # by a trial that resumes
    config = replace(tuning.config, num_seeds=tuning.seeds)
    try:
        # a fault of the machine must not count against the settings of a trial
        training.prepare(config, replace(tuning.options, num_processes=1))
        study = open_study(tuning, 1 + number)
        enough = MaxTrialsCallback(tuning.trials, UNDER_WAY)
        study.optimize(lambda trial: _train(tuning, study, trial), callbacks=[enough])
    except RunError as end:
        terminal.say(str(end))
        return end.exit_code
    except ConfigError as reason:
        terminal.warn(f"stopped: {reason}")
        return 1
    return 0


def _train(tuning: Tuning, study: Study, trial: Trial) -> float:
    """Train one trial in its own run directory, resumed if the trial is a retry.

    Returns:
        The mean return of the policies at the end, over all seeds and episodes.

    Raises:
        TrialPruned: the settings are invalid together, diverge or are worse than the median.
        RunError: a signal stopped the run, or a fault of the machine; the trial is enqueued again.
    """
    values = {path: _suggest(trial, path, each) for path, each in tuning.space.items()}
    number = trial.user_attrs.get("run", trial.number)  # a retry has the attributes of the trial
    trial.set_user_attr("run", number)
    terminal.say(f"trial {trial.number}: {values}")
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
            num_processes=1,
        )
        training.prepare(config, options)
    except ConfigError as reason:
        raise optuna.TrialPruned(str(reason)) from reason

    def report(steps: int, result: dict[str, Any]) -> None:
        trial.report(result["return_mean"], steps // every)
        if trial.should_prune():
            raise optuna.TrialPruned(f"worse than the median after {steps:,} steps")

    try:
        value = float(training.train(config, options, report).evaluation["return_mean"])
    except DivergedError as reason:
        raise optuna.TrialPruned(str(reason)) from reason
    except RunError:
        _retry(study, study.trials[trial.number])
        raise
    if not math.isfinite(value):
        raise optuna.TrialPruned("its return is not finite")
    return value


def _suggest(trial: Trial, path: str, distribution: Distribution) -> Any:
    if isinstance(distribution, CategoricalDistribution):
        return trial.suggest_categorical(path, distribution.choices)
    is_whole = isinstance(distribution, IntDistribution)
    suggest: Any = trial.suggest_int if is_whole else trial.suggest_float
    return suggest(path, distribution.low, distribution.high, log=distribution.log)
