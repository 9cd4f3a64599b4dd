"""A run from its configuration to its evaluation, on disk: started, resumed, or whichever of the two there is to do."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.configs.serial import MAY_CHANGE, differences
from dgae_jax.envs.registry import spec_of
from dgae_jax.learn.build import make_task
from dgae_jax.learn.memory import check_memory
from dgae_jax.learn.types import TrainState
from dgae_jax.run import (
    checkpoint,
    compiling,
    directory,
    hosts,
    machine,
    manifest,
    restore,
    terminal,
)
from dgae_jax.run.evaluations import EvaluationsFile
from dgae_jax.run.options import RunOptions, validate_options
from dgae_jax.run.summary import describe
from dgae_jax.run.training import Heed, RunError, TaskFailedError, run_to_end, unheeded


class Finished(NamedTuple):
    """A run that reached its end."""

    evaluation: dict[str, Any]
    """What `evaluation.json` holds."""
    directory: Path


def start(config: ResolvedConfig, options: RunOptions, heed: Heed = unheeded) -> Finished:
    """Train, evaluate, and write a new run directory.

    Raises ConfigError before anything is written or compiled if the configuration or a path is invalid, RunError if the run
    ends early, and what `heed` raises at an evaluation.
    """
    config, options = prepared(config, options)
    with hosts.writing(options.run_dir or directory.default_path(config)) as run_dir:
        directory.create(run_dir, config, options)
        with directory.locked(run_dir):
            return Finished(run_to_end(config, options, run_dir, None, heed), run_dir)


def go_on(config: ResolvedConfig, options: RunOptions, heed: Heed = unheeded) -> Finished:
    """Continue the run in `options.resume` from its latest whole checkpoint, as if it had never stopped.

    Raises as `start`; ConfigError also, naming both values, for a setting other than `total_steps` that differs from the run's,
    or for another machine or version; CheckpointError if no checkpoint can be loaded.
    """
    config, options = prepared(config, options)
    assert options.resume is not None
    _compare(config, directory.read_config(options.resume), options.resume, options)
    with hosts.writing(options.resume) as run_dir, directory.locked(run_dir):
        return Finished(
            run_to_end(config, options, run_dir, _last_state(run_dir, config), heed), run_dir
        )


def go_on_or_start(config: ResolvedConfig, options: RunOptions, heed: Heed = unheeded) -> Finished:
    """`go_on` in `options.run_dir` if a run was begun there, `start` otherwise; raises as they do."""
    validate_options(options, resolve(config))
    hosts.join(options)
    if options.run_dir is not None and hosts.first(directory.has_begun(options.run_dir)):
        return go_on(
            config,
            dataclasses.replace(
                options, resume=options.run_dir, run_dir=None, resume_or_start=False
            ),
            heed,
        )
    return start(config, options, heed)


def train(config: ResolvedConfig, options: RunOptions) -> int:
    """`start`, and the process's exit code: 0, 1 if it broke down, 130 / 143 / 129 after a signal."""
    return _exit_code(start, config, options)


def resume(config: ResolvedConfig, options: RunOptions) -> int:
    """`go_on`, and the exit code as `train`."""
    return _exit_code(go_on, config, options)


def resume_or_start(config: ResolvedConfig, options: RunOptions) -> int:
    """`go_on_or_start`, and the exit code as `train`."""
    return _exit_code(go_on_or_start, config, options)


def _exit_code(
    work: Callable[[ResolvedConfig, RunOptions], Finished],
    config: ResolvedConfig,
    options: RunOptions,
) -> int:
    """Say how it went. The process ends here where Python would wait for XLA, or JAX say a task's failure again, with its own stack."""
    try:
        finished = work(config, options)
    except RunError as end:
        if hosts.is_first():
            (terminal.say if end.exit_code > 128 else terminal.warn)(str(end))
        if compiling.is_running() or isinstance(end, TaskFailedError):
            os._exit(end.exit_code)
        return end.exit_code
    with terminal.silenced(not hosts.is_first()):
        terminal.say(f"{describe(finished.evaluation)}; files in {finished.directory}")
    return 0


def prepared(config: ResolvedConfig, options: RunOptions) -> tuple[ResolvedConfig, RunOptions]:
    """Configuration and options in full, after a look at everything that can be seen before work begins; raises ConfigError."""
    config = resolve(config)
    validate_options(options, config)
    devices = machine.use_devices(config, options)
    machine.use_cache(options.cache_dir)
    check_memory(config, make_task(config), machine.memory())
    return config, dataclasses.replace(options, devices=devices)


def _compare(
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
    elsewhere = "; ".join(manifest.changes(run_dir, options))
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
    if not checkpoint.found(run_dir / "checkpoints"):
        if EvaluationsFile(run_dir / "evaluations.jsonl").rows:
            raise ConfigError(
                f"{run_dir}: must hold a checkpoint; it had some when it was evaluated, checkpoints/ has none"
            )
        terminal.say(f"{run_dir} has no checkpoint yet: it starts again")
        return None
    state, path = restore.training_state(run_dir, config)
    done = config.samples_per_iteration * int(state.iteration[0])
    if config.total_steps < done:
        raise invalid(
            "total_steps", config.total_steps, f"at least the {done} that are done in {run_dir}"
        )
    terminal.say(f"resuming from {path.name}")
    return restore.in_new_episodes(state, config) if spec_of(config.env).on_host else state
