"""One run from its configuration to its evaluation, on disk: started or resumed."""

import contextlib
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import MAY_CHANGE, differences
from dgae_jax.envs.registry import spec_of
from dgae_jax.learn.build import make_task, seed_keys
from dgae_jax.learn.devices import make_mesh
from dgae_jax.learn.memory import check_memory
from dgae_jax.learn.parallel import make_trainer
from dgae_jax.learn.types import TrainState
from dgae_jax.run import checkpoint, directory, files, runtime, terminal
from dgae_jax.run.checkpoint import NotFiniteError
from dgae_jax.run.evaluation import describe
from dgae_jax.run.logger import RunLogger
from dgae_jax.run.metrics import EvaluationsFile
from dgae_jax.run.options import RunOptions, validate_options
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


def train(
    config: ResolvedConfig, options: RunOptions, on_eval: EvalCallback | None = None
) -> tuple[dict[str, Any], Path]:
    """Train, evaluate and write a run directory, new or continued.

    Args:
        config: the resolved configuration.
        options: `resume` continues the run in that directory bit for bit; `resume_or_start`
            continues the run in `run_dir` if there is one; otherwise a new run starts.
        on_eval: called at every periodic evaluation.

    Returns:
        What `evaluation.json` holds, and the run directory.

    Raises:
        ConfigError: invalid options or paths, or a changed machine; nothing is written.
        CheckpointError: no checkpoint of the run can be loaded.
        RunError: the run ends early.
    """
    if options.resume_or_start and options.run_dir:
        runtime.join_processes(options)
        if runtime.largest(directory.has_begun(options.run_dir)):
            options = replace(options, resume=options.run_dir, run_dir=None, resume_or_start=False)
    options = prepare(config, options)
    if options.resume is not None:
        _check_resumable(config, options.resume, options)
    path = options.resume or options.run_dir or directory.default_path(config)
    new = options.resume is None
    with (
        runtime.writing_directory(path) as run_dir,
        directory.created(run_dir, config, options) if new else directory.locked(run_dir),
    ):
        state = None if new else _last_state(run_dir, config)
        with Signals() as signals, _run_errors(config, run_dir, signals):
            task, size = f"{config.task} {config.algo} on {config.physics}", config.iterations
            budget = f"{size:,} iterations × {config.samples_per_iteration:,} samples"
            terminal.say(f"{task}: {budget} × {counted(config.num_seeds, 'seed')}")
            done = 0 if state is None else int(state.iteration[0])
            with RunLogger(run_dir, config, options, done) as logger:
                if not new:
                    directory.continue_run(run_dir, config, options)
                state = _iterate(logger, signals, state, on_eval)
                if skipped := logger.metrics.skipped:
                    terminal.warn(f"warning: {skipped:,} iterations skipped a non-finite update")
                with Reporter(page=logger.page) as reporter:
                    evaluation = logger.evaluate(state, signals.watching(reporter.watch))
            files.write_json(run_dir / "evaluation.json", evaluation)
        return evaluation, run_dir


def train_command(config: ResolvedConfig, options: RunOptions) -> int:
    """Train, print the outcome and return the exit code: 0, 1, or 128 + the signal.

    The process ends here where Python would wait for XLA, or JAX print a task's failure again.
    """
    try:
        evaluation, run_dir = train(config, options)
    except RunError as end:
        if jax.process_index() == 0:
            (terminal.say if end.exit_code > 128 else terminal.warn)(str(end))
        if runtime.is_compiling() or spec_of(config.env).on_host:
            os._exit(end.exit_code)
        return end.exit_code
    with terminal.silenced(jax.process_index() > 0):
        terminal.say(f"{describe(evaluation)}; files in {run_dir}")
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
    return replace(options, devices=devices)


def _check_resumable(config: ResolvedConfig, run_dir: Path, options: RunOptions) -> None:
    """Refuse what would not continue the run bit for bit, unless it is `inexact`."""
    changed = differences(config, directory.read_config(run_dir))
    for path, (ours, theirs) in changed.items():
        if path not in MAY_CHANGE:
            raise invalid(path, ours, f"{theirs} as in {run_dir}, or left out")
    reasons = directory.environment_changes(run_dir, options)
    if "physics" in changed:
        ours, theirs = changed["physics"]
        reasons.append(f"physics {ours} (was {theirs})")
    if spec_of(config.env).on_host:
        reasons.append(f"the envs of {config.env} begin new episodes")
    if reasons and not options.inexact:
        why = f"not bit-identical ({'; '.join(reasons)}); add --inexact to continue anyway"
        raise ConfigError(f"resume {run_dir}: {why}", "resume")
    for reason in reasons:
        terminal.warn(f"warning: {reason}: the run is not bit-identical from here on")


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


@contextlib.contextmanager
def _run_errors(config: ResolvedConfig, run_dir: Path, signals: Signals) -> Iterator[None]:
    """Turn what may end a run early into RunError, which says how to continue."""
    try:
        yield
    except Stopped:
        message = f"stopped by {signals.received.name}; continue with --resume {run_dir}"
        raise RunError(128 + signals.received, message) from None
    except NotFiniteError as reason:
        why = f"{reason}, which is not saved"
        raise DivergedError(1, f"stopped: {why}; {_left(run_dir)}") from reason
    except OSError as reason:
        why = f"{reason.filename or 'output'}: cannot be written ({reason.strerror})"
        raise RunError(1, f"stopped: {why}; {_left(run_dir)}") from reason
    except (MemoryError, jax.errors.JaxRuntimeError) as reason:
        why = str(reason).partition("\n")[0][:200] or type(reason).__name__
        if re.search("RESOURCE_EXHAUSTED|MemoryError|bad_alloc", repr(reason)):
            what = "out of memory"
        elif spec_of(config.env).on_host:
            what = f"{config.env} failed"
        else:
            raise
        raise RunError(1, f"stopped: {what} ({why}); {_left(run_dir)}") from reason


def _left(run_dir: Path) -> str:
    """Return from what a run can continue."""
    if saved := checkpoint.checkpoints_in(run_dir / "checkpoints"):
        return f"continue from {saved[-1].name} with --resume {run_dir}"
    return "there is no checkpoint"


def _iterate(
    logger: RunLogger, signals: Signals, state: TrainState | None, on_eval: EvalCallback | None
) -> TrainState:
    """Run the iterations that are left, until the budget is used or a signal came.

    Raises:
        DivergedError: too many iterations failed; the last finite state is saved.
    """
    config, options = logger.config, logger.options
    samples, done = config.samples_per_iteration, logger.metrics.iteration
    every = max(1, options.checkpoint_every // samples)
    mesh = make_mesh((options.devices or 1) * jax.process_count())
    trainer = make_trainer(make_task(config), CAPACITY, mesh)
    with Reporter(config.iterations * samples, config.num_seeds, logger.page) as reporter:
        watch = signals.watching(reporter.watch)
        if state is None:
            compile_in_thread(trainer.init, config, seed_keys(config), watch=watch)
            state = trainer.init(config, seed_keys(config))
        if done < config.iterations:
            compile_in_thread(trainer.dispatch, config, state, 1, watch=watch)
        failures = runtime.gather(state.failures)
        most, count, seconds = failures.max(), 1, 0.0
        stopping = signals.anywhere()
        while True:
            if most >= options.max_nonfinite:
                why = f"non-finite updates, or most env steps masked, in {most} iterations in a row"
                where = f"the last finite state is in {logger.run_dir}"
                raise DivergedError(1, f"stopped: {why}; {where}")
            if 0 < done < config.iterations and done % every == 0 and not logger.evaluated:
                with contextlib.suppress(Stopped):  # a resumed run makes up for it
                    result = logger.evaluate(state, watch)
                    if on_eval is not None:
                        on_eval(logger.steps, result)
                stopping = signals.anywhere()  # all is saved
            if done == config.iterations or stopping:
                return state
            count = min(count, config.iterations - done, every - done % every)
            since, warm = time.monotonic(), seconds > 0
            state, measured = trainer.dispatch(config, state, count)
            measured = runtime.gather(measured)
            mean_return = logger.append(state, measured, count)
            failures, most = _count_failures(failures, measured, count, samples)
            seconds, done = (time.monotonic() - since) / count, done + count
            if warm:  # the first dispatch says nothing about speed
                reporter.update(done * samples, samples / seconds, mean_return)
                count = runtime.largest(int(np.clip(DISPATCH_SECONDS / seconds, 1, CAPACITY)))
            last = done == config.iterations or most >= options.max_nonfinite
            stopping = signals.anywhere()
            if stopping or last or done % every == 0:
                logger.save(state)


def _count_failures(
    failures: np.ndarray, measured: dict[str, Any], count: int, samples: int
) -> tuple[np.ndarray, int]:
    """Return failed iterations in a row [S] after `count` more, and the most on the way there."""
    most = 0
    for i in range(count):
        failed = (measured["skipped"][i] > 0) | (measured["nonfinite"][i] > samples / 2)
        failures = np.where(failed, failures + 1, 0)
        most = max(most, int(failures.max()))
    return failures, most
