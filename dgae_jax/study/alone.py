"""A trial as an ordinary run in its own directory, which is continued where it was left."""

import dataclasses
import math

import optuna
from optuna.trial import Trial

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import runtime, training
from dgae_jax.run.training import DivergedError
from dgae_jax.study.storage import first_number
from dgae_jax.study.tuning import Tuning, quarter, value_of


def ready(tuning: Tuning) -> None:
    """Look at the machine before trials are taken; raises ConfigError where none could be trained on it."""
    config = dataclasses.replace(tuning.config, num_seeds=tuning.seeds)
    runtime.use_devices(config, dataclasses.replace(tuning.options, num_processes=1))
    runtime.use_cache(tuning.options.cache_dir)


def train(tuning: Tuning, study: optuna.Study, trial: Trial) -> float:
    """The value of a trial.

    Raises TrialPruned where its settings do not go together or with this machine, break down or are worse than most, RunError if it was
    stopped.
    """
    try:
        config = tuning.config_of(trial.params)
        every = quarter(config) * config.samples_per_iteration
        here = tuning.directory / "trials" / f"{first_number(study, trial):04d}"
        kept = {"checkpoint_every": every, "keep_checkpoints": 1, "num_processes": 1}
        options = dataclasses.replace(
            tuning.options, run_dir=here, resume_or_start=True, inexact=True, **kept
        )
        training.prepare(
            config, options
        )  # `ready` has seen that it is not the machine that is at fault
    except ConfigError as reason:
        raise optuna.TrialPruned(str(reason)) from reason

    def heed(steps: int, result: dict) -> None:
        trial.report(value_of(result), steps // every)
        if trial.should_prune():
            raise optuna.TrialPruned(f"worse than most were after {steps:,} steps")

    try:
        value = value_of(training.train(config, options, heed).evaluation)
    except DivergedError as reason:
        raise optuna.TrialPruned(str(reason)) from reason
    if not math.isfinite(value):
        raise optuna.TrialPruned("its return is not finite")
    return value
