"""One run, from its state to its evaluation: dispatch by dispatch until the budget is used or something ends it."""

import contextlib
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import spec_of
from dgae_jax.learn.build import make_task, make_trainer, policies_of, seed_keys
from dgae_jax.learn.devices import make_mesh
from dgae_jax.learn.parallel import Trainer
from dgae_jax.learn.types import TrainState
from dgae_jax.run import checkpoint, directory, files, hosts, manifest, terminal
from dgae_jax.run.checkpoint import NotFiniteError
from dgae_jax.run.compiling import compile_aside
from dgae_jax.run.engines import engine_of, referee
from dgae_jax.run.options import RunOptions
from dgae_jax.run.progress import Reporter
from dgae_jax.run.record import Record
from dgae_jax.run.signals import Signals, Stopped
from dgae_jax.run.summary import counted

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


Heed = Callable[[int, dict[str, Any]], None]
"""Told samples per run and result of every evaluation on the way, when its checkpoint is on its way to the disk. What it raises
ends the run, which can be resumed."""


def unheeded(steps: int, result: dict[str, Any]) -> None:
    """Let every run go on."""


def run_to_end(
    config: ResolvedConfig,
    options: RunOptions,
    run_dir: Path,
    state: TrainState | None,
    heed: Heed = unheeded,
) -> dict[str, Any]:
    """Train what is left, evaluate, and write `evaluation.json`, which is returned. Raises RunError, and what `heed` raises."""
    terminal.say(_budget(config))
    done = 0 if state is None else int(state.iteration[0])
    with Signals() as signals:
        try:
            with Record(run_dir, config, options, done) as record:
                if options.resume:
                    directory.write_config(run_dir, config)
                    manifest.add(run_dir, options)
                state = _iterate(config, options, record, signals, state, heed)
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
    record: Record,
    signals: Signals,
    state: TrainState | None,
    heed: Heed,
) -> TrainState:
    """All iterations that are left, until the budget is used or a signal came; raises DivergedError, with all saved."""
    every = max(1, options.checkpoint_every // config.samples_per_iteration)
    done, count, seconds = record.metrics.iteration, 1, 0.0
    row = (
        np.zeros(config.num_seeds, int)
        if state is None
        else np.asarray(hosts.whole(state.failures))
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
            _look(
                record, state, signals, reporter, heed
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
                hosts.first(int(np.clip(DISPATCH_SECONDS / seconds, 1, CAPACITY))) if warm else 1
            )
            due, stopping = done % every == 0, signals.anywhere()
            if due or done == config.iterations or stopping or broken:
                record.save(state)
                record.draw()
            _check(rows, options, record.run_dir)
            if due and done < config.iterations:
                _look(record, state, signals, reporter, heed)
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
            compile_aside(trainer.init, config, seed_keys(config), watch=watch)
            state = trainer.init(config, seed_keys(config))
        compile_aside(trainer.dispatch, config, state, 1, watch=watch)
    return state


def _dispatch(
    config: ResolvedConfig, trainer: Trainer, state: TrainState, count: int, record: Record
) -> tuple[TrainState, dict[str, Any]]:
    """The next iterations; if there is no memory for them, the state before is saved, as far as it was not consumed."""
    try:
        state, measured = jax.block_until_ready(trainer.dispatch(config, state, count))
        return state, hosts.whole(measured)
    except (MemoryError, jax.errors.JaxRuntimeError) as reason:
        if (
            _is_out_of_memory(reason)
            and record.steps
            and not any(x.is_deleted() for x in jax.tree.leaves(state))
        ):
            record.save(state)
        raise


def _look(
    record: Record, state: TrainState, signals: Signals, reporter: Reporter, heed: Heed
) -> None:
    """Evaluate on the way, unless a signal came: a run that goes on later makes up for it."""
    if not record.evaluated:
        with contextlib.suppress(Stopped), signals.may_stop(reporter.watch) as watch:
            heed(record.steps, record.evaluate(hosts.whole(policies_of(state)), watch))


def _evaluate(
    config: ResolvedConfig, options: RunOptions, record: Record, signals: Signals, state: TrainState
) -> dict[str, Any]:
    """The evaluation at the end, which may take longer than a short training."""
    with Reporter(page=record.page) as reporter, signals.may_stop(reporter.watch) as watch:
        episodes = counted(options.episodes, "episode") + (
            f" of each of {config.num_seeds} seeds" if config.num_seeds > 1 else ""
        )
        reporter.announce(
            f"evaluating {episodes} in {referee(config)} ({engine_of(config, options.eval_engine)})"
        )
        return record.evaluate(hosts.whole(policies_of(state)), watch)


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
    saved = checkpoint.found(run_dir / "checkpoints")
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
