"""One run, from its state to its evaluation: dispatch by dispatch until the budget is used or something ends it."""

import contextlib
import dataclasses
import itertools
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.serial import MAY_CHANGE, differences
from dgae_jax.envs.registry import spec_of
from dgae_jax.learn.build import make_task, make_trainer, policies_of, seed_keys
from dgae_jax.learn.devices import make_mesh
from dgae_jax.learn.memory import check_memory
from dgae_jax.learn.parallel import Trainer
from dgae_jax.learn.types import TrainState
from dgae_jax.run import checkpoint, directory, files, runtime, terminal
from dgae_jax.run.checkpoint import NotFiniteError
from dgae_jax.run.evaluation import describe
from dgae_jax.run.logger import RunLogger
from dgae_jax.run.metrics import EvaluationsFile
from dgae_jax.run.options import RunOptions, engine_of, eval_env_id, validate_options
from dgae_jax.run.runtime import Signals, Stopped, compile_in_thread
from dgae_jax.run.terminal import Reporter, counted

CAPACITY = 64
"""Most iterations in one dispatch."""
DISPATCH_SECONDS = 2.0
"""Aim for the time between looks at metrics, clock and signals."""


class RunError(RuntimeError):
    """A run that ended before its time; the message says why and how to go on."""

    def __init__(self, exit_code: int, message: str):
        super().__init__(message)
        self.exit_code = exit_code
        """1 broke down or could write no more; 130, 143, 129 stopped by SIGINT, SIGTERM, SIGHUP."""


class DivergedError(RunError):
    """A run whose updates or worlds are not finite any more: its settings are to blame, not the machine."""


class TaskFailedError(RunError):
    """A run whose task raised an exception in the middle of a program."""


EvalCallback = Callable[[int, dict[str, Any]], None]
"""Told samples per run and result of every evaluation on the way, when its checkpoint is on its way to the disk. What it raises
ends the run, which can be resumed."""


def run_to_end(
    config: ResolvedConfig,
    options: RunOptions,
    run_dir: Path,
    state: TrainState | None,
    on_eval: EvalCallback | None = None,
) -> dict[str, Any]:
    """Train what is left, evaluate, and write `evaluation.json`, which is returned. Raises RunError, and what `on_eval` raises."""
    terminal.say(_budget(config))
    done = 0 if state is None else int(state.iteration[0])
    with Signals() as signals:
        try:
            with RunLogger(run_dir, config, options, done) as record:
                if options.resume:
                    directory.write_config(run_dir, config)
                    directory.extend_manifest(run_dir, options)
                state = _iterate(config, options, record, signals, state, on_eval)
                if record.metrics.skipped:
                    of = config.iterations * config.num_seeds
                    terminal.warn(
                        f"warning: in {record.metrics.skipped:,} of {of:,} iterations an update was not finite and was left out"
                    )
                result = _evaluate(config, options, record, signals, state)
            files.write_json(run_dir / "evaluation.json", result)
        except Stopped:
            raise RunError(
                signals.exit_code, f"stopped by {signals.name}; continue with --resume {run_dir}"
            ) from None
        except NotFiniteError as reason:
            raise DivergedError(
                1, f"stopped: {reason}, which is not saved; {_left(run_dir)}"
            ) from reason
        except OSError as reason:
            name = reason.filename or "output"
            raise RunError(
                1, f"stopped: {name}: cannot be written ({reason.strerror}); {_left(run_dir)}"
            ) from reason
        except (MemoryError, jax.errors.JaxRuntimeError) as reason:
            why = str(reason).partition("\n")[0][:200] or type(reason).__name__
            if _is_out_of_memory(reason):
                raise RunError(1, f"stopped: out of memory ({why}); {_left(run_dir)}") from reason
            if spec_of(config.env).on_host:
                raise TaskFailedError(
                    1, f"stopped: {config.env} failed ({why}); {_left(run_dir)}"
                ) from reason
            raise
    return result


def _iterate(
    config: ResolvedConfig,
    options: RunOptions,
    record: RunLogger,
    signals: Signals,
    state: TrainState | None,
    on_eval: EvalCallback | None,
) -> TrainState:
    """All iterations that are left, until the budget is used or a signal came; raises DivergedError, with all saved."""
    every = max(1, options.checkpoint_every // config.samples_per_iteration)
    done, count, seconds = record.metrics.iteration, 1, 0.0
    row = (
        np.zeros(config.num_seeds, int)
        if state is None
        else np.asarray(runtime.gather(state.failures))
    )
    if state is not None and done == config.iterations:
        _check(row, options, record.run_dir)
        return state
    trainer = make_trainer(
        make_task(config), CAPACITY, make_mesh((options.devices or 1) * jax.process_count())
    )
    with Reporter(
        config.iterations * config.samples_per_iteration, config.num_seeds, record.page
    ) as reporter:
        resumed = state is not None
        state = _compiled(config, trainer, state, signals, reporter)
        if resumed and done % every == 0:
            _periodic_eval(
                record, state, signals, reporter, on_eval
            )  # unless it was evaluated before it stopped
        stopping = signals.anywhere()
        while done < config.iterations and not stopping:
            count = min(count, config.iterations - done, every - done % every)
            since, warm = time.monotonic(), seconds > 0
            state, measured = _dispatch(config, trainer, state, count, record)
            mean_return, rows = (
                record.append(state, measured, count),
                _failures(row, measured, count, config.samples_per_iteration),
            )
            row, broken = rows[-1], rows.max() >= options.max_nonfinite
            seconds, done = (time.monotonic() - since) / count, done + count
            if warm:  # the first dispatch says nothing about speed
                reporter.update(
                    done * config.samples_per_iteration,
                    config.samples_per_iteration / seconds,
                    mean_return,
                )
            count = (
                runtime.of_first(int(np.clip(DISPATCH_SECONDS / seconds, 1, CAPACITY)))
                if warm
                else 1
            )
            due, stopping = done % every == 0, signals.anywhere()
            if due or done == config.iterations or stopping or broken:
                record.save(state)
                record.draw()
            _check(rows, options, record.run_dir)
            if due and done < config.iterations:
                _periodic_eval(record, state, signals, reporter, on_eval)
                stopping = signals.anywhere()  # all is saved
    return state


def _compiled(
    config: ResolvedConfig,
    trainer: Trainer,
    state: TrainState | None,
    signals: Signals,
    reporter: Reporter,
) -> TrainState:
    """The state to begin with, when the programs are compiled. Nothing is lost by ending meanwhile."""
    reporter.announce("compiling")
    with signals.may_stop(reporter.watch) as watch:
        if state is None:
            compile_in_thread(trainer.init, config, seed_keys(config), watch=watch)
            state = trainer.init(config, seed_keys(config))
        compile_in_thread(trainer.dispatch, config, state, 1, watch=watch)
    return state


def _dispatch(
    config: ResolvedConfig, trainer: Trainer, state: TrainState, count: int, record: RunLogger
) -> tuple[TrainState, dict[str, Any]]:
    """The next iterations; if there is no memory for them, the state before is saved, as far as it was not consumed."""
    try:
        state, measured = jax.block_until_ready(trainer.dispatch(config, state, count))
        return state, runtime.gather(measured)
    except (MemoryError, jax.errors.JaxRuntimeError) as reason:
        if (
            _is_out_of_memory(reason)
            and record.steps
            and not any(x.is_deleted() for x in jax.tree.leaves(state))
        ):
            record.save(state)
        raise


def _periodic_eval(
    record: RunLogger,
    state: TrainState,
    signals: Signals,
    reporter: Reporter,
    on_eval: EvalCallback | None,
) -> None:
    """Evaluate on the way, unless a signal came: a run that goes on later makes up for it."""
    if not record.evaluated:
        with contextlib.suppress(Stopped), signals.may_stop(reporter.watch) as watch:
            result = record.evaluate(runtime.gather(policies_of(state)), watch)
            if on_eval is not None:
                on_eval(record.steps, result)


def _evaluate(
    config: ResolvedConfig,
    options: RunOptions,
    record: RunLogger,
    signals: Signals,
    state: TrainState,
) -> dict[str, Any]:
    """The evaluation at the end, which may take longer than a short training."""
    with Reporter(page=record.page) as reporter, signals.may_stop(reporter.watch) as watch:
        episodes = counted(options.episodes, "episode") + (
            f" of each of {config.num_seeds} seeds" if config.num_seeds > 1 else ""
        )
        reporter.announce(
            f"evaluating {episodes} in {eval_env_id(config)} ({engine_of(config, options.eval_engine)})"
        )
        return record.evaluate(runtime.gather(policies_of(state)), watch)


def _failures(before: np.ndarray, measured: dict[str, Any], count: int, samples: int) -> np.ndarray:
    """How many iterations in a row have failed at each of `count` [count, S], as `TrainState.failures` [S] counts: an iteration that
    succeeds in between ends a row, and a dispatch does not hide it.
    """
    skipped, nonfinite = (np.asarray(measured[name])[:count] for name in ("skipped", "nonfinite"))
    failed = (skipped > 0) | (nonfinite > samples / 2)
    rows = itertools.accumulate(
        failed, lambda row, fails: np.where(fails, row + 1, 0), initial=before
    )
    return np.stack(list(rows)[1:])


def _check(failures: np.ndarray, options: RunOptions, run_dir: Path) -> None:
    """Raise DivergedError where too many iterations in a row have failed."""
    if (most := int(failures.max())) >= options.max_nonfinite:
        reason = f"in {most} iterations in a row updates were not finite and were left out, or most world steps were not finite"
        raise DivergedError(1, f"stopped: {reason}; the last finite state is in {run_dir}")


def _left(run_dir: Path) -> str:
    """From what a run can go on."""
    saved = checkpoint.checkpoints_in(run_dir / "checkpoints")
    return (
        f"continue from {saved[-1].name} with --resume {run_dir}"
        if saved
        else "there is no checkpoint"
    )


def _is_out_of_memory(reason: Exception) -> bool:
    return isinstance(reason, MemoryError) or any(
        word in str(reason) for word in ("RESOURCE_EXHAUSTED", "MemoryError", "bad_alloc")
    )


def _budget(config: ResolvedConfig) -> str:
    runs, samples = (
        f" × {config.num_seeds} seeds" if config.num_seeds > 1 else "",
        config.samples_per_iteration,
    )
    used = (
        f"{config.iterations:,} iterations × {samples:,} samples = {config.iterations * samples:,}"
    )
    return f"{config.task} {config.algo} on {config.physics}: {used} of {config.total_steps:,} steps{runs}"


class Finished(NamedTuple):
    """A run that reached its end."""

    evaluation: dict[str, Any]
    """What `evaluation.json` holds."""
    directory: Path


def train(
    config: ResolvedConfig, options: RunOptions, on_eval: EvalCallback | None = None
) -> Finished:
    """Train, evaluate and write a run directory, new or continued.

    Args:
        config: the resolved configuration.
        options: `resume` continues the run in that directory bit for bit; `resume_or_start`
            continues the run in `run_dir` if there is one; otherwise a new run starts.
        on_eval: called at every periodic evaluation; what it raises ends the run.

    Raises:
        ConfigError: invalid configuration, options or paths, before anything is written.
        CheckpointError: no checkpoint of the run can be loaded.
        RunError: the run ends early.
    """
    if options.resume_or_start:
        validate_options(options, config)
        runtime.join_processes(options)
        there = options.run_dir is not None and directory.has_begun(options.run_dir)
        if runtime.of_first(there):
            options = dataclasses.replace(options, resume=options.run_dir, run_dir=None)
        else:
            options = dataclasses.replace(options, inexact=False)
        options = dataclasses.replace(options, resume_or_start=False)
    config, options = prepare(config, options)
    if options.resume is None:
        return _start(config, options, on_eval)
    return _resume(config, options, options.resume, on_eval)


def _start(config: ResolvedConfig, options: RunOptions, on_eval: EvalCallback | None) -> Finished:
    with runtime.writing_directory(options.run_dir or directory.default_path(config)) as run_dir:
        directory.create(run_dir, config, options)
        with directory.locked(run_dir):
            return Finished(run_to_end(config, options, run_dir, None, on_eval), run_dir)


def _resume(
    config: ResolvedConfig, options: RunOptions, path: Path, on_eval: EvalCallback | None
) -> Finished:
    _check_resumable(config, directory.read_config(path), path, options)
    with runtime.writing_directory(path) as run_dir, directory.locked(run_dir):
        state = _last_state(run_dir, config)
        return Finished(run_to_end(config, options, run_dir, state, on_eval), run_dir)


def train_command(config: ResolvedConfig, options: RunOptions) -> int:
    """Train, print the outcome and return the exit code: 0, 1, or 128 + the signal.

    The process ends here where Python would wait for XLA, or JAX print a task's failure again.
    """
    try:
        finished = train(config, options)
    except RunError as end:
        if runtime.is_first():
            (terminal.say if end.exit_code > 128 else terminal.warn)(str(end))
        if runtime.is_compiling() or isinstance(end, TaskFailedError):
            os._exit(end.exit_code)
        return end.exit_code
    with terminal.silenced(not runtime.is_first()):
        terminal.say(f"{describe(finished.evaluation)}; files in {finished.directory}")
    return 0


def prepare(config: ResolvedConfig, options: RunOptions) -> tuple[ResolvedConfig, RunOptions]:
    """Configuration and options in full, after a look at everything that can be seen before work begins; raises ConfigError."""
    config = resolve(config)
    validate_options(options, config)
    devices = runtime.use_devices(config, options)
    runtime.use_cache(options.cache_dir)
    check_memory(config, make_task(config), runtime.available_memory())
    return config, dataclasses.replace(options, devices=devices)


def _check_resumable(
    config: ResolvedConfig, saved: ResolvedConfig, run_dir: Path, options: RunOptions
) -> None:
    """Refuse what would not continue the run `saved`, but for what --inexact allows."""
    changed, inexact = differences(config, saved), options.inexact
    on_host = spec_of(config.env).on_host
    if on_host and not inexact:
        raise ConfigError(
            f"resume {run_dir}: must be with --inexact; the worlds of {config.env} are not in a checkpoint",
            "resume",
        )
    for path, (ours, theirs) in changed.items():
        if path not in MAY_CHANGE or (path == "physics" and not inexact):
            raise invalid(path, ours, f"{theirs} as in {run_dir}, or left out")
    elsewhere = "; ".join(directory.environment_changes(run_dir, options))
    if elsewhere and not inexact:
        raise ConfigError(
            f"resume {run_dir}: must go on where it began, or with --inexact; now {elsewhere}",
            "resume",
        )
    if "physics" in changed:
        ours, theirs = changed["physics"]
        _warn_of_another_sample(
            f"physics {ours} (was {theirs}): one step differs by up to 1e-4, of ant on mjx by up to 1"
        )
    if on_host:
        _warn_of_another_sample(
            f"the worlds of {config.env} are not in a checkpoint and begin new episodes"
        )
    if elsewhere:
        _warn_of_another_sample(
            f"{elsewhere}: rounding differs, by up to 1e-6 relative per operation, if nothing else does"
        )


def _warn_of_another_sample(reason: str) -> None:
    terminal.warn(f"warning: {reason}, so the rest is another sample")


def _last_state(run_dir: Path, config: ResolvedConfig) -> TrainState | None:
    """From the latest whole checkpoint; None if the run stopped before its first."""
    if not checkpoint.checkpoints_in(run_dir / "checkpoints"):
        if EvaluationsFile(run_dir / "evaluations.jsonl").rows:
            raise ConfigError(
                f"{run_dir}: must hold a checkpoint; it had some when it was evaluated, checkpoints/ has none"
            )
        terminal.say(f"{run_dir} has no checkpoint yet: it starts again")
        return None
    state, path = checkpoint.latest_train_state(run_dir, config)
    done = config.samples_per_iteration * int(state.iteration[0])
    if config.total_steps < done:
        raise invalid(
            "total_steps", config.total_steps, f"at least the {done} that are done in {run_dir}"
        )
    terminal.say(f"resuming from {path.name}")
    return checkpoint.reset_episodes(state, config) if spec_of(config.env).on_host else state
