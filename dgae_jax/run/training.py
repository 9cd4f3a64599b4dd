"""One run from its configuration to its evaluation, on disk: started or resumed."""

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
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
"""Target time between looks at metrics, clock and signals."""

EvalCallback = Callable[[int, dict[str, Any]], None]
"""Called with samples per run and result of each periodic evaluation. What it raises ends the run,
which can be resumed."""


class RunError(RuntimeError):
    """A run that ended early; the message says why and how to continue."""

    def __init__(self, exit_code: int, message: str):
        super().__init__(message)
        self.exit_code = exit_code
        """1 after a failure; 130, 143, 129 after SIGINT, SIGTERM, SIGHUP."""


class DivergedError(RunError):
    """A run with updates or envs that are no longer finite, because of its hyperparameters."""


class TaskFailedError(RunError):
    """A task raised an exception inside a program."""


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
        on_eval: called at every periodic evaluation.

    Raises:
        ConfigError: invalid options or paths, or a changed machine; nothing is written.
        CheckpointError: no checkpoint of the run can be loaded.
        RunError: the run ends early.
    """
    if options.resume_or_start:
        validate_options(options, config)
        runtime.join_processes(options)
        there = options.run_dir is not None and directory.has_begun(options.run_dir)
        if runtime.of_first(there):
            options = dataclasses.replace(options, resume=options.run_dir, run_dir=None)
        inexact = options.inexact and options.resume is not None
        options = dataclasses.replace(options, resume_or_start=False, inexact=inexact)
    options = prepare(config, options)
    if options.resume is not None:
        _check_resumable(config, directory.read_config(options.resume), options.resume, options)
    path = options.resume or options.run_dir or directory.default_path(config)
    with runtime.writing_directory(path) as run_dir:
        new = options.resume is None
        with directory.created(run_dir, config, options) if new else directory.locked(run_dir):
            state = None if new else _last_state(run_dir, config)
            return Finished(_run_to_end(config, options, run_dir, state, on_eval), run_dir)


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


def prepare(config: ResolvedConfig, options: RunOptions) -> RunOptions:
    """Check all that can be checked before work begins; return the options with their devices.

    Raises:
        ConfigError: invalid options, devices that do not exist, or too little memory.
    """
    validate_options(options, config)
    devices = runtime.use_devices(config, options)
    runtime.use_cache(options.cache_dir)
    check_memory(config, make_task(config), runtime.available_memory())
    return dataclasses.replace(options, devices=devices)


def _check_resumable(
    config: ResolvedConfig, saved: ResolvedConfig, run_dir: Path, options: RunOptions
) -> None:
    """Refuse what would not continue the run bit for bit, unless it is `inexact`."""
    changed, inexact = differences(config, saved), options.inexact
    on_host = spec_of(config.env).on_host
    if on_host and not inexact:
        why = f"the envs of {config.env} are not in a checkpoint"
        raise ConfigError(f"resume {run_dir}: must be with --inexact; {why}", "resume")
    for path, (ours, theirs) in changed.items():
        if path not in MAY_CHANGE or (path == "physics" and not inexact):
            raise invalid(path, ours, f"{theirs} as in {run_dir}, or left out")
    elsewhere = "; ".join(directory.environment_changes(run_dir, options))
    if elsewhere and not inexact:
        must = "must be as it began, or with --inexact"
        raise ConfigError(f"resume {run_dir}: {must}; now {elsewhere}", "resume")
    reasons = []
    if "physics" in changed:
        ours, theirs = changed["physics"]
        bound = "one step differs by up to 1e-4, of ant on mjx by up to 1"
        reasons.append(f"physics {ours} (was {theirs}): {bound}")
    if on_host:
        reasons.append(f"the envs of {config.env} are not in a checkpoint and begin new episodes")
    if elsewhere:
        reasons.append(f"{elsewhere}: rounding differs, by up to 1e-6 relative per operation")
    for reason in reasons:
        terminal.warn(f"warning: {reason}; the rest is not bit-identical")


def _last_state(run_dir: Path, config: ResolvedConfig) -> TrainState | None:
    """Return the latest whole checkpoint; None if the run stopped before its first."""
    if not checkpoint.checkpoints_in(run_dir / "checkpoints"):
        if EvaluationsFile(run_dir / "evaluations.jsonl").rows:
            why = "it had some when it was evaluated, checkpoints/ has none"
            raise ConfigError(f"{run_dir}: must hold a checkpoint; {why}")
        terminal.say(f"{run_dir} has no checkpoint yet: it starts again")
        return None
    state, path = checkpoint.latest_train_state(run_dir, config)
    done = config.samples_per_iteration * int(state.iteration[0])
    if config.total_steps < done:
        least = f"at least the {done} that are done in {run_dir}"
        raise invalid("total_steps", config.total_steps, least)
    terminal.say(f"resuming from {path.name}")
    return checkpoint.reset_episodes(state, config) if spec_of(config.env).on_host else state


def _run_to_end(
    config: ResolvedConfig,
    options: RunOptions,
    run_dir: Path,
    state: TrainState | None,
    on_eval: EvalCallback | None,
) -> dict[str, Any]:
    """Train what is left, evaluate, and write `evaluation.json`, which is returned."""
    terminal.say(_budget(config))
    done = 0 if state is None else int(state.iteration[0])
    with Signals() as signals, _run_errors(config, run_dir, signals):
        with RunLogger(run_dir, config, options, done) as logger:
            if options.resume:
                directory.write_config(run_dir, config)
                directory.extend_manifest(run_dir, options)
            state = _iterate(logger, signals, state, on_eval)
            if logger.metrics.skipped:
                of = config.iterations * config.num_seeds
                skipped = f"{logger.metrics.skipped:,} of {of:,} iterations"
                terminal.warn(f"warning: in {skipped} a non-finite update was skipped")
            result = _final_eval(logger, signals, state)
        files.write_json(run_dir / "evaluation.json", result)
    return result


@contextlib.contextmanager
def _run_errors(config: ResolvedConfig, run_dir: Path, signals: Signals) -> Iterator[None]:
    """Turn what may end a run early into RunError, which says how to continue."""
    try:
        yield
    except Stopped:
        message = f"stopped by {signals.name}; continue with --resume {run_dir}"
        raise RunError(signals.exit_code, message) from None
    except NotFiniteError as reason:
        why = f"{reason}, which is not saved"
        raise DivergedError(1, f"stopped: {why}; {_left(run_dir)}") from reason
    except OSError as reason:
        why = f"{reason.filename or 'output'}: cannot be written ({reason.strerror})"
        raise RunError(1, f"stopped: {why}; {_left(run_dir)}") from reason
    except (MemoryError, jax.errors.JaxRuntimeError) as reason:
        why = str(reason).partition("\n")[0][:200] or type(reason).__name__
        if _is_out_of_memory(reason):
            raise RunError(1, f"stopped: out of memory ({why}); {_left(run_dir)}") from reason
        if spec_of(config.env).on_host:
            message = f"stopped: {config.env} failed ({why}); {_left(run_dir)}"
            raise TaskFailedError(1, message) from reason
        raise


def _iterate(
    logger: RunLogger, signals: Signals, state: TrainState | None, on_eval: EvalCallback | None
) -> TrainState:
    """Run the iterations that are left, until the budget is used or a signal came.

    Raises:
        DivergedError: too many iterations failed; the last finite state is saved.
    """
    config, options = logger.config, logger.options
    samples, seeds = config.samples_per_iteration, config.num_seeds
    every = max(1, options.checkpoint_every // samples)
    done, count, seconds = logger.metrics.iteration, 1, 0.0
    failures = np.zeros(seeds, int)
    if state is not None:
        failures = np.asarray(runtime.gather(state.failures))
        if done == config.iterations:
            _check_failures(failures, logger)
            return state
    mesh = make_mesh((options.devices or 1) * jax.process_count())
    trainer = make_trainer(make_task(config), CAPACITY, mesh)
    with Reporter(config.iterations * samples, seeds, logger.page) as reporter:
        resumed = state is not None
        state = _compiled(logger, trainer, state, signals, reporter)
        if resumed and done % every == 0:
            _periodic_eval(logger, state, signals, reporter, on_eval)  # if it stopped before
        stopping = signals.anywhere()
        while done < config.iterations and not stopping:
            count = min(count, config.iterations - done, every - done % every)
            since, warm = time.monotonic(), seconds > 0
            state, measured = _dispatch(logger, trainer, state, count)
            mean_return = logger.append(state, measured, count)
            history = _failures(failures, measured, count, samples)
            failures, broken = history[-1], history.max() >= options.max_nonfinite
            seconds, done = (time.monotonic() - since) / count, done + count
            count = 1
            if warm:  # the first dispatch says nothing about speed
                reporter.update(done * samples, samples / seconds, mean_return)
                fitting = np.clip(DISPATCH_SECONDS / seconds, 1, CAPACITY)
                count = runtime.of_first(int(fitting))
            due, stopping = done % every == 0, signals.anywhere()
            if due or done == config.iterations or stopping or broken:
                logger.save(state)
                logger.draw()
            _check_failures(history, logger)
            if due and done < config.iterations:
                _periodic_eval(logger, state, signals, reporter, on_eval)
                stopping = signals.anywhere()  # all is saved
    return state


def _compiled(
    logger: RunLogger,
    trainer: Trainer,
    state: TrainState | None,
    signals: Signals,
    reporter: Reporter,
) -> TrainState:
    """Compile the programs and return the state to begin with; a signal may end it at once."""
    config = logger.config
    reporter.announce("compiling")
    with signals.may_stop(reporter.watch) as watch:
        if state is None:
            compile_in_thread(trainer.init, config, seed_keys(config), watch=watch)
            state = trainer.init(config, seed_keys(config))
        compile_in_thread(trainer.dispatch, config, state, 1, watch=watch)
    return state


def _dispatch(
    logger: RunLogger, trainer: Trainer, state: TrainState, count: int
) -> tuple[TrainState, dict[str, Any]]:
    """Run the next iterations; out of memory, save the state before unless it was donated."""
    try:
        state, measured = jax.block_until_ready(trainer.dispatch(logger.config, state, count))
        return state, runtime.gather(measured)
    except (MemoryError, jax.errors.JaxRuntimeError) as reason:
        donated = any(x.is_deleted() for x in jax.tree.leaves(state))
        if _is_out_of_memory(reason) and logger.steps and not donated:
            logger.save(state)
        raise


def _periodic_eval(
    logger: RunLogger,
    state: TrainState,
    signals: Signals,
    reporter: Reporter,
    on_eval: EvalCallback | None,
) -> None:
    """Evaluate the policies, unless done before or a signal came: a resumed run makes up for it."""
    if logger.evaluated:
        return
    with contextlib.suppress(Stopped), signals.may_stop(reporter.watch) as watch:
        result = logger.evaluate(runtime.gather(policies_of(state)), watch)
        if on_eval is not None:
            on_eval(logger.steps, result)


def _final_eval(logger: RunLogger, signals: Signals, state: TrainState) -> dict[str, Any]:
    config, options = logger.config, logger.options
    with Reporter(page=logger.page) as reporter, signals.may_stop(reporter.watch) as watch:
        episodes = counted(options.episodes, "episode")
        episodes += f" of each of {config.num_seeds} seeds" if config.num_seeds > 1 else ""
        engine = engine_of(config, options.eval_engine)
        reporter.announce(f"evaluating {episodes} in {eval_env_id(config)} ({engine})")
        return logger.evaluate(runtime.gather(policies_of(state)), watch)


def _failures(before: np.ndarray, measured: dict[str, Any], count: int, samples: int) -> np.ndarray:
    """Count failed iterations in a row after each of `count` iterations [count, S].

    As `TrainState.failures` [S] does; here a success within a dispatch is seen too.
    """
    skipped, nonfinite = (np.asarray(measured[name])[:count] for name in ("skipped", "nonfinite"))
    failed = (skipped > 0) | (nonfinite > samples / 2)
    history = [before]
    for fails in failed:
        history.append(np.where(fails, history[-1] + 1, 0))
    return np.stack(history[1:])


def _check_failures(failures: np.ndarray, logger: RunLogger) -> None:
    if (most := int(failures.max())) >= logger.options.max_nonfinite:
        why = f"non-finite updates, or most env steps masked, in {most} iterations in a row"
        raise DivergedError(1, f"stopped: {why}; the last finite state is in {logger.run_dir}")


def _left(run_dir: Path) -> str:
    """Return from what a run can continue."""
    with contextlib.suppress(OSError):
        if saved := checkpoint.checkpoints_in(run_dir / "checkpoints"):
            return f"continue from {saved[-1].name} with --resume {run_dir}"
    return "there is no checkpoint"


def _is_out_of_memory(reason: Exception) -> bool:
    words = "RESOURCE_EXHAUSTED", "MemoryError", "bad_alloc"
    return isinstance(reason, MemoryError) or any(word in str(reason) for word in words)


def _budget(config: ResolvedConfig) -> str:
    runs = f" × {config.num_seeds} seeds" if config.num_seeds > 1 else ""
    iterations, samples = config.iterations, config.samples_per_iteration
    used = f"{iterations:,} iterations × {samples:,} samples = {iterations * samples:,}"
    run = f"{config.task} {config.algo} on {config.physics}"
    return f"{run}: {used} of {config.total_steps:,} steps{runs}"
