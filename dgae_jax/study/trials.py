"""Which trials a process takes, so that all processes together finish as many as were asked for."""

import datetime

import optuna
from optuna.trial import FrozenTrial, Trial, TrialState

from dgae_jax.study.storage import distributions, unwarned
from dgae_jax.study.tuning import Tuning

DONE = (TrialState.COMPLETE, TrialState.PRUNED)


def finished(study: optuna.Study) -> list[FrozenTrial]:
    """The trials that count: to their end, or as far as they were worth it."""
    return study.get_trials(deepcopy=False, states=DONE)


def is_over(study: optuna.Study, tuning: Tuning) -> bool:
    """Whether enough trials are finished."""
    return len(finished(study)) >= tuning.trials


def take(study: optuna.Study, tuning: Tuning) -> list[Trial]:
    """Up to `side_by_side` trials for this process; none where others are at work on all that are left.

    Trials of processes that were lost come first.
    """
    with unwarned():
        optuna.storages.fail_stale_trials(study)
        _give_up_the_silent(study, tuning)
        under_way = study.get_trials(deepcopy=False, states=(*DONE, TrialState.RUNNING))
        free = min(tuning.side_by_side, tuning.trials - len(under_way))
        space = distributions(tuning)
        taken = [study.ask(space) for _ in range(free)]
    return [trial for trial in taken if _is_wanted(study, tuning, trial)]


def _is_wanted(study: optuna.Study, tuning: Tuning, trial: Trial) -> bool:
    """Two processes may take the last trial at once: the later one gives way."""
    before = [
        t
        for t in study.get_trials(deepcopy=False, states=(*DONE, TrialState.RUNNING))
        if t.number < trial.number
    ]
    if len(before) < tuning.trials:
        return True
    study.tell(trial, state=TrialState.FAIL)
    return False


def _give_up_the_silent(study: optuna.Study, tuning: Tuning) -> None:
    """Fail trials whose process was lost between taking them and their first sign of life, which Optuna waits for forever."""
    long_ago = datetime.datetime.now() - datetime.timedelta(seconds=60 + 3 * tuning.heartbeat)
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if (
            "taken" not in trial.user_attrs
            and trial.datetime_start is not None
            and trial.datetime_start < long_ago
        ):
            study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)
