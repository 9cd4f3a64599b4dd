"""Where a tuning's trials are kept: an Optuna study in SQLite or PostgreSQL, which any number of processes share."""

import contextlib
import threading
import time
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import optuna
import sqlalchemy.exc
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.trial import FrozenTrial, Trial, TrialState

from dgae_jax.configs.config import invalid
from dgae_jax.configs.serial import differences, from_dict, to_dict
from dgae_jax.run.options import engine_of
from dgae_jax.study.search import Choice, Range, values_of
from dgae_jax.study.tuning import Tuning

RETRIES = 5
"""Times a trial is taken up again whose process was lost: its settings may be what ends processes."""

WAIT = 60
"""Longest time that a process waits for another that writes to the same SQLite file [s]."""

FACTS = "tuning"
"""The study's attribute that says what is tuned."""

JUDGED = {"seeds": "tuning_seeds", "episodes": "episodes", "eval_engine": "eval_engine"}
"""What of it trials are judged by, and the flags."""


@contextlib.contextmanager
def unwarned() -> Iterator[None]:
    """Optuna warns of features that may change, of asking outside of its loop, and of values that are reported again."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def open_storage(tuning: Tuning) -> RDBStorage:
    """The database, made if there is none; raises ConfigError if it cannot be reached."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    file = f"sqlite:///{tuning.directory.absolute() / 'optuna.db'}"
    engine: dict[str, Any] = (
        {"pool_pre_ping": True} if tuning.storage else {"connect_args": {"timeout": WAIT}}
    )
    for attempt in range(5):
        try:
            with unwarned():
                retry = RetryHeartbeatStaleTrialCallback(RETRIES, inherit_intermediate_values=True)
                beat: dict[str, Any] = {
                    "heartbeat_interval": tuning.heartbeat,
                    "grace_period": 3 * tuning.heartbeat,
                }
                return RDBStorage(
                    tuning.storage or file, engine, **beat, heartbeat_stale_trial_callback=retry
                )
        except (
            sqlalchemy.exc.SQLAlchemyError,
            optuna.exceptions.OptunaError,
            ImportError,
        ) as reason:
            if attempt < 4 and any(
                words in str(reason)
                for words in ("already exists", "duplicate key", "UNIQUE constraint")
            ):
                time.sleep(0.5)  # another process is making the tables
                continue
            why = str(getattr(reason, "orig", None) or reason).partition("\n")[0]
            raise invalid(
                "storage", _shown(tuning.storage or file), f"a database that can be reached ({why})"
            ) from reason
    raise AssertionError


def _shown(url: str) -> str:
    """The address without the password."""
    return sqlalchemy.engine.make_url(url).render_as_string(hide_password=True)


def open_study(tuning: Tuning, storage: RDBStorage, worker: int = 0) -> optuna.Study:
    """The study of the tuning's directory, made if there is none; the first trial is the configuration itself.

    Raises ConfigError, naming what differs, if it tunes something else.
    """
    study = optuna.create_study(
        storage=storage, study_name=tuning.directory.absolute().name, direction="maximize", load_if_exists=True,
        pruner=optuna.pruners.MedianPruner(),
    )  # fmt: skip
    _agree(study, tuning)
    if not study.get_trials(deepcopy=False) and not tuning.outside:
        study.enqueue_trial(values_of(tuning.config, tuning.space), skip_if_exists=True)
    entropy = (
        tuning.sampler_seed,
        worker,
        len(study.get_trials(deepcopy=False)),
    )  # one that goes on draws other numbers
    study.sampler = optuna.samplers.TPESampler(
        seed=int(np.random.SeedSequence(entropy).generate_state(1)[0])
    )
    return study


def _agree(study: optuna.Study, tuning: Tuning) -> None:
    """Write what is tuned, or refuse another."""
    ours = {
        "config": to_dict(tuning.config),
        "search": {path: str(each) for path, each in tuning.space.items()},
        "seeds": tuning.seeds,
        "episodes": tuning.options.episodes,
        "eval_engine": engine_of(tuning.config, tuning.options.eval_engine),
    }
    theirs = study.user_attrs.get(FACTS)
    if theirs is None:
        study.set_user_attr(FACTS, ours)
        return
    changed = {flag: (ours[name], theirs.get(name, ours[name])) for name, flag in JUDGED.items()}
    changed |= {
        f"search {path}": (ours["search"].get(path), theirs["search"].get(path))
        for path in {**ours["search"], **theirs["search"]}
    }
    changed |= differences(tuning.config, from_dict(theirs["config"]))
    for setting, (now, then) in changed.items():
        if now != then:
            raise invalid(
                setting, now, f"{then} as in the study {study.study_name}, or with another --study"
            )


def distributions(tuning: Tuning) -> dict[str, BaseDistribution]:
    """What is searched, in Optuna's words."""
    return {path: _distribution(dimension) for path, dimension in tuning.space.items()}


def _distribution(dimension: Range | Choice) -> BaseDistribution:
    if isinstance(dimension, Choice):
        return CategoricalDistribution(dimension.values)
    kind = IntDistribution if dimension.whole else FloatDistribution
    return kind(dimension.low, dimension.high, log=dimension.log)  # pyright: ignore[reportArgumentType]


def requeue(study: optuna.Study, trial: Trial) -> None:
    """Give a trial back that was stopped: whoever asks next takes it up again."""
    with unwarned():
        failed = study.tell(trial, state=TrialState.FAIL, skip_if_finished=True)
        RetryHeartbeatStaleTrialCallback(inherit_intermediate_values=True)(study, failed)


def first_number(study: optuna.Study, trial: Trial | FrozenTrial) -> int:
    """The number that a trial had before it was taken up again."""
    with unwarned():
        frozen = study.get_trials(deepcopy=False)[trial.number]
        first = RetryHeartbeatStaleTrialCallback.retried_trial_number(frozen)
    return trial.number if first is None else first


@contextlib.contextmanager
def alive(
    study: optuna.Study, storage: RDBStorage, trials: list[Trial], every: float
) -> Iterator[None]:
    """Signs of life of trials while they run, which Optuna gives in its own loop only."""
    over = threading.Event()

    def beat():
        while True:
            with contextlib.suppress(
                optuna.exceptions.StorageInternalError, sqlalchemy.exc.SQLAlchemyError
            ):
                for trial in trials:
                    storage.record_heartbeat(trial._trial_id)
            if over.wait(every):
                return

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        for trial in trials:
            trial.set_user_attr("taken", time.time())
        yield
    finally:
        over.set()
        thread.join()
