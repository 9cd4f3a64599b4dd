"""A run from its configuration to its evaluation, on disk."""

import contextlib
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from dgae_jax.configs.build import make_task, make_trainer, seed_keys
from dgae_jax.configs.config import Config, ConfigError, flag
from dgae_jax.configs.serial import MAY_CHANGE, differences
from dgae_jax.configs.validation import validate
from dgae_jax.learn.types import TrainState
from dgae_jax.run import checkpoint, directory, files, machine, manifest
from dgae_jax.run.evaluation import EvaluationsFile
from dgae_jax.run.options import RunOptions, validate_options
from dgae_jax.run.progress import Reporter
from dgae_jax.run.record import Record
from dgae_jax.run.signals import Signals, Stopped

CAPACITY = 64
"""Most iterations in one dispatch."""
DISPATCH_SECONDS = 2.0
"""Aim for the time between looks at metrics, clock and signals."""


def train(config: Config, options: RunOptions) -> int:
    """Train, evaluate, and write the run directory.

    Returns the process's exit code: 0, 1 if training broke down or nothing could be written any more, or 130 / 143 after a
    signal. Raises ConfigError before anything is written or compiled if the configuration or a path cannot be.
    """
    config = _prepared(config, options)
    run_dir = options.run_dir or directory.default_path(config)
    directory.create(run_dir, config, options)
    with directory.locked(run_dir):
        return _run(config, options, run_dir, None)


def resume(config: Config, options: RunOptions) -> int:
    """Continue the run in `options.resume` from its newest whole checkpoint, as if it had never stopped.

    Returns as `train`. Raises ConfigError, naming both values, for a setting other than `total_steps` that differs from the
    run's, or for another machine or version; CheckpointError if no checkpoint can be loaded.
    """
    config = _prepared(config, options)
    run_dir = options.resume
    assert run_dir is not None
    _compare(config, directory.read_config(run_dir), run_dir, options.inexact)
    with directory.locked(run_dir):
        return _run(config, options, run_dir, _last_state(run_dir, config))


def _prepared(config: Config, options: RunOptions) -> Config:
    """The configuration in full, after a look at everything that can be seen before work begins."""
    config = validate(config)
    validate_options(options)
    machine.use_device(config)
    machine.use_cache(options.cache_dir)
    return config


def _compare(config: Config, saved: Config, run_dir: Path, inexact: bool) -> None:
    """Refuse what would not continue the run `saved`, but for what `inexact` allows."""
    changed = differences(config, saved)
    for path, (ours, theirs) in changed.items():
        if path not in MAY_CHANGE or (path == "physics" and not inexact):
            raise ConfigError(f"{flag(path)} {ours}: must be {theirs} as in {run_dir}, or left out")
    elsewhere = "; ".join(manifest.changes(run_dir))
    if elsewhere and not inexact:
        raise ConfigError(f"--resume {run_dir}: must go on where it began, or with --inexact; now {elsewhere}")
    if "physics" in changed:
        ours, theirs = changed["physics"]
        _warn_of_another_sample(f"physics {ours} (was {theirs}): one step differs by up to 1e-4")
    if elsewhere:
        _warn_of_another_sample(f"{elsewhere}: rounding differs, by up to 1e-6 relative per operation, if nothing else does")


def _warn_of_another_sample(reason: str) -> None:
    print(f"warning: {reason}, so the rest is another sample", file=sys.stderr)


def _last_state(run_dir: Path, config: Config) -> TrainState | None:
    """From the newest whole checkpoint; None if the run stopped before its first."""
    if not checkpoint.found(run_dir / "checkpoints"):
        if EvaluationsFile(run_dir / "evaluations.jsonl").rows:
            raise ConfigError(f"{run_dir}: must hold a checkpoint; it had some when it was evaluated, checkpoints/ has none")
        print(f"{run_dir} has no checkpoint yet: it starts again")
        return None
    state, path = checkpoint.newest(run_dir, config)
    done = config.samples_per_iteration * int(state.iteration[0])
    if config.total_steps < done:
        raise ConfigError(f"--total-steps {config.total_steps}: must be at least the {done} that are done in {run_dir}")
    print(f"resuming from {path.name}")
    return state


def _run(config: Config, options: RunOptions, run_dir: Path, state: TrainState | None) -> int:
    print(_budget(config), flush=True)
    done = 0 if state is None else int(state.iteration[0])
    with Signals() as signals:
        try:
            with Record(run_dir, config, options, done) as record:
                if options.resume:
                    directory.write_config(run_dir, config)
                    manifest.add(run_dir, options)
                state = _iterate(config, options, record, signals, state)
                if _broken(state, options):
                    return _broke_down(state, run_dir)
                with signals.may_stop():
                    result = record.evaluate(state)
            files.write_json(run_dir / "evaluation.json", result)
        except Stopped:
            print(f"stopped by {signals.name}; continue with --resume {run_dir}", flush=True)
            return signals.exit_code
        except OSError as reason:
            return _cannot_write(reason, run_dir)
    print(f"{describe(result)}; files in {run_dir}", flush=True)
    return 0


def _iterate(config: Config, options: RunOptions, record: Record, signals: Signals, state: TrainState | None) -> TrainState:
    """All iterations that are left, dispatch by dispatch, until the budget is used, a signal came, or it broke down."""
    every = max(1, options.checkpoint_every // config.samples_per_iteration)
    done, count, compiled = record.metrics.iteration, 1, False
    if state is not None and done == config.iterations:
        return state
    trainer = make_trainer(make_task(config), CAPACITY)
    with Reporter(config.iterations * config.samples_per_iteration, config.num_seeds) as reporter:
        if state is None:
            state = trainer.init(config, seed_keys(config))
        elif done % every == 0:
            _look(record, state, signals)  # unless it was evaluated before it stopped
        while done < config.iterations and not (signals.received and compiled):
            count = min(count, config.iterations - done, every - done % every)
            since = time.monotonic()
            state, measured = trainer.dispatch(config, state, count)
            mean_return = record.append(state, measured, count)
            seconds, done = (time.monotonic() - since) / count, done + count
            if compiled:  # the first dispatch says nothing about speed
                reporter.update(done * config.samples_per_iteration, config.samples_per_iteration / seconds, mean_return)
            count = int(np.clip(DISPATCH_SECONDS / seconds, 1, CAPACITY)) if compiled else 1
            compiled, broken, due = True, _broken(state, options), done % every == 0
            if due or done == config.iterations or signals.received or broken:
                record.save(state)
                record.draw()
            if broken:
                break
            if due and done < config.iterations:
                _look(record, state, signals)
    return state


def _look(record: Record, state: TrainState, signals: Signals) -> None:
    """Evaluate on the way, unless a signal came: a run that goes on later makes up for it."""
    if not record.evaluated:
        with contextlib.suppress(Stopped), signals.may_stop():
            record.evaluate(state)


def _broken(state: TrainState, options: RunOptions) -> bool:
    return int(state.failures.max()) >= options.max_nonfinite


def _broke_down(state: TrainState, run_dir: Path) -> int:
    lately = f"in each of the last {int(state.failures.max())} iterations"
    reason = f"{lately} updates were not finite and were left out, or most world steps were not finite"
    print(f"stopped: {reason}; the last finite state is in {run_dir}", file=sys.stderr)
    return 1


def _cannot_write(reason: OSError, run_dir: Path) -> int:
    saved = checkpoint.found(run_dir / "checkpoints")
    left = f"continue from {saved[-1].name} with --resume {run_dir}" if saved else "there is no checkpoint"
    print(f"stopped: {reason.filename or 'output'}: cannot be written ({reason.strerror}); {left}", file=sys.stderr)
    return 1


def _budget(config: Config) -> str:
    runs, samples = f" × {config.num_seeds} seeds" if config.num_seeds > 1 else "", config.samples_per_iteration
    used = f"{config.iterations:,} iterations × {samples:,} samples = {config.iterations * samples:,}"
    task = config.env if config.env_version is None else f"{config.env}-{config.env_version}"
    return f"{task} {config.algo} on {config.physics}: {used} of {config.total_steps:,} steps{runs}"


def describe(result: dict[str, Any]) -> str:
    """An evaluation in one line."""
    return (
        f"return {result['return_mean']:,.1f} ± {result['return_std']:,.1f} over {result['episodes']} episodes"
        f" of the deterministic policy in {result['env']} ({result['engine']})"
    )
