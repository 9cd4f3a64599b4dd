"""A tuning: an Optuna study of training runs, shared by processes and machines.

The study is DIRECTORY/optuna.db or in PostgreSQL; the run of each trial is DIRECTORY/trials/NUMBER.
"""

import json
import math
import time
import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import optuna
import sqlalchemy.exc
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial, TrialState

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.serial import to_dict
from dgae_jax.run import terminal, training
from dgae_jax.run.options import engine_of
from dgae_jax.run.runtime import Signals
from dgae_jax.run.training import DivergedError, RunError
from dgae_jax.study import outcome
from dgae_jax.study.launch import LaunchOptions, local
from dgae_jax.study.search import Tuning
from dgae_jax.study.worker import Job

QUARTERS = 4
"""Parts of a trial; at the end of each but the last a trial worse than the median is pruned."""

POLL = 0.5
"""Time between looks at the study [s]."""


def tune(tuning: Tuning) -> int:
    """Finish the trials of a tuning, together with all processes that share it.

    Returns:
        The exit code: 0 done, 1 trials are missing, 128 + a signal that stopped it.

    Raises:
        ConfigError: the directory or the database cannot be used, or tunes something else.
    """
    try:
        (tuning.directory / "trials").mkdir(parents=True, exist_ok=True)
        study = open_study(tuning)
        done = len(outcome.finished(study))
        workers = range(min(tuning.workers, tuning.trials - done))
        logs = [tuning.directory / f"worker-{i}.log" for i in workers]
        jobs = [Job(log.stem, work, (tuning, i), log) for i, log in enumerate(logs)]
        with Signals() as signals, local(jobs, LaunchOptions(processes=len(jobs))) as tasks:
            while not signals.received and not all(task.done() for task in tasks):
                time.sleep(POLL)
                done = outcome.say_new(study, done)
        if (done := outcome.say_new(study, done)) < tuning.trials:
            how = f"by {signals.received.name}" if signals.received else f"early, see {logs[0]}"
            said = f"{done} of {tuning.trials} trials are finished; the same command continues"
            terminal.say(f"stopped {how}: {said}")
            return 128 + signals.received if signals.received else 1
        return outcome.write(tuning, study)
    except OSError as reason:
        allowed = f"a directory that can be written ({reason.strerror})"
        raise invalid("study", tuning.directory, allowed) from reason


def open_study(tuning: Tuning, worker: int = 0) -> Study:
    """Open the study of a tuning, or create it with the configuration's own values as a trial.

    Raises:
        ConfigError: the database cannot be reached, or the study tunes something else.
    """
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    # SQLite has one writer at a time; others wait for up to a minute
    url = tuning.storage or f"sqlite:///{tuning.directory.absolute() / 'optuna.db'}?timeout=60"
    try:
        storage = optuna.storages.RDBStorage(
            url,
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
        address = sqlalchemy.make_url(url).render_as_string(hide_password=True)
        why = str(getattr(reason, "orig", None) or reason).partition("\n")[0]
        raise invalid("storage", address, f"a database that can be reached ({why})") from reason
    search = {path: each.text for path, each in tuning.space.items()}
    engine = engine_of(tuning.config, tuning.options.eval_engine)
    tuned = [to_dict(tuning.config), search, tuning.seeds, tuning.options.episodes, engine]
    ours = json.dumps(tuned, sort_keys=True)
    if study.user_attrs.get("tuning", ours) != ours:
        allowed = "new, or of the same settings, search, seeds, episodes and evaluation engine"
        raise invalid("study", tuning.directory, allowed)
    study.set_user_attr("tuning", ours)
    count = len(study.get_trials(deepcopy=False))
    if not count and (start := tuning.start_values()):
        study.enqueue_trial(start, skip_if_exists=True)
    # a worker that continues draws other numbers than it drew before
    entropy = np.random.SeedSequence((tuning.sampler_seed, worker, count))
    study.sampler = optuna.samplers.TPESampler(seed=int(entropy.generate_state(1)[0]))
    return study


def _retry(study: Study, trial: FrozenTrial) -> None:
    """Enqueue a trial again, with what it has reported; its settings may be what kills it."""
    retry = optuna.storages.RetryHeartbeatStaleTrialCallback
    retry(5, inherit_intermediate_values=True)(study, trial)


def work(tuning: Tuning, number: int = 0) -> int:
    """Train trials until enough are finished, here or elsewhere; return the exit code."""
    warnings.filterwarnings("ignore", "The reported value is ignored")  # by a trial that resumes
    config = replace(tuning.config, num_seeds=tuning.seeds)
    # a fault of the machine must not count against the settings of a trial
    training.prepare(config, replace(tuning.options, num_processes=1))
    study = open_study(tuning, 1 + number)
    while len(outcome.finished(study)) < tuning.trials:
        optuna.storages.fail_stale_trials(study)
        states = (*outcome.FINISHED, TrialState.RUNNING)
        taken = study.get_trials(deepcopy=False, states=states)
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


def _train(tuning: Tuning, study: Study, trial: Trial) -> float:
    """Train a trial in its run directory; one that a signal or a fault stops is tried again."""
    values = {path: each.suggest(trial, path) for path, each in tuning.space.items()}
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
            num_processes=1,
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
