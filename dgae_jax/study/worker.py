"""One process of a tuning: it takes trials, trains them and tells what they are worth, until enough are finished."""

import os
import sys
import time

import optuna
from optuna.storages import RDBStorage
from optuna.trial import Trial, TrialState

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import runtime, terminal
from dgae_jax.run.runtime import Signals, Stopped
from dgae_jax.run.training import RunError
from dgae_jax.study import alone, side_by_side
from dgae_jax.study.storage import alive, open_storage, open_study, requeue, unwarned
from dgae_jax.study.trials import is_over, take
from dgae_jax.study.tuning import Tuning

POLL = 0.5
"""Time between looks at trials that others are at work on [s]."""


def serve(tuning: Tuning, worker: int) -> int:
    """Work on a tuning: 0 when it is over, 130 / 143 when it was stopped, 1 when it cannot go on."""
    try:
        if tuning.side_by_side == 1:
            alone.ready(tuning)
        storage = open_storage(tuning)
        code = _serve(tuning, open_study(tuning, storage, worker), storage)
    except (ConfigError, RunError) as reason:
        terminal.warn(f"stopped: {reason}")
        code = 1
    if runtime.is_compiling():  # Python would wait for it
        sys.stdout.flush()
        os._exit(code)
    return code


def _serve(tuning: Tuning, study: optuna.Study, storage: RDBStorage) -> int:
    with Signals() as signals:
        while not (signals.received or is_over(study, tuning)):
            taken = take(study, tuning)
            if not taken:
                time.sleep(POLL)
                continue
            with alive(study, storage, taken, tuning.heartbeat):
                code = (
                    _together(tuning, study, taken, signals)
                    if tuning.side_by_side > 1
                    else _one(tuning, study, taken[0])
                )
            if code:
                return code
        return signals.exit_code if signals.received else 0


def _one(tuning: Tuning, study: optuna.Study, trial: Trial) -> int:
    """Train one trial and tell its value; the exit code if it was stopped, otherwise 0."""
    terminal.say(f"trial {trial.number}: {trial.params}")
    try:
        with unwarned():
            value = alone.train(tuning, study, trial)
    except optuna.TrialPruned as reason:
        terminal.say(f"trial {trial.number} pruned: {reason}")
        study.tell(trial, state=TrialState.PRUNED, skip_if_finished=True)
    except optuna.exceptions.UpdateFinishedTrialError:
        terminal.say(f"trial {trial.number} was taken over by another process")
    except RunError as end:
        requeue(study, trial)
        terminal.say(str(end))
        return end.exit_code
    except BaseException:
        study.tell(trial, state=TrialState.FAIL, skip_if_finished=True)
        raise
    else:
        study.tell(trial, value, skip_if_finished=True)
    return 0


def _together(tuning: Tuning, study: optuna.Study, trials: list[Trial], signals: Signals) -> int:
    """As `_one`, for several trials in one program."""
    try:
        with unwarned():
            values = side_by_side.train(tuning, study, trials, signals)
    except Stopped:
        for trial in trials:
            requeue(study, trial)
        return signals.exit_code
    except BaseException:
        for trial in trials:
            study.tell(trial, state=TrialState.FAIL, skip_if_finished=True)
        raise
    for trial, value in zip(trials, values, strict=True):
        state = TrialState.PRUNED if value is None else TrialState.COMPLETE
        study.tell(trial, value, state, skip_if_finished=True)
    return 0
