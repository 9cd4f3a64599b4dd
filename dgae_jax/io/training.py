"""A run from its configuration to its evaluation, on disk."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.build import make_task, make_trainer, seed_keys
from dgae_jax.config import Config, ConfigError, differences, flag, resolve, to_dict
from dgae_jax.envs.registry import BRAX
from dgae_jax.io import checkpoint, metrics, plots, run_directory
from dgae_jax.io.evaluation import evaluate_state
from dgae_jax.io.progress import Reporter
from dgae_jax.io.signals import Signals
from dgae_jax.physics.base import PhysicsState
from dgae_jax.types import TrainState
from dgae_jax.validation import validate

CAPACITY = 64
"""Most iterations in one dispatch."""
DISPATCH_SECONDS = 2.0
"""Aim for the time between looks at metrics, clock and signals."""


@dataclass(frozen=True)
class RunOptions:
    """What a run leaves on this machine; nothing here changes its result."""

    run_dir: Path | None = None
    """Directory to write, new or empty; by default runs/ENV-ALGO-SEED-TIME [path]."""
    cache_dir: str = "~/.cache/dgae_jax"
    """Where compiled programs are kept between runs (JAX keeps those of mjx, not of native); none disables [path]."""
    checkpoint_every: int = 200_000
    """Samples of each run between checkpoints; one is always saved at the end [environment steps]."""
    resume: Path | None = None
    """Continue the run in this directory, bit for bit; other flags may be left out [path]."""
    other_physics: bool = False
    """Let --resume continue with another --physics: the same in the statistical sense only."""
    max_nonfinite: int = 10
    """Updates in a row that may turn out non-finite, and be left out, before the run is stopped [iterations]."""
    episodes: int = 20
    """Episodes of the final evaluation in Gymnasium, per run [episodes]."""
    debug_nonfinite: bool = False
    """Write the state and action of worlds that turn non-finite to nonfinite/ in the run directory, for replay."""


def validate_options(options: RunOptions) -> None:
    """Raise `ConfigError` for the first option that cannot be."""
    for name in ("checkpoint_every", "episodes", "max_nonfinite"):
        value = getattr(options, name)
        if value < 1:
            raise ConfigError(f"{flag(name)} {value}: must be a whole number of at least 1")


def train(config: Config, options: RunOptions) -> int:
    """Train, evaluate, and write the run directory.

    Returns the process's exit code: 0, 1 if training broke down, or 130 / 143 after a signal. Raises ConfigError before
    anything is written or compiled if the configuration or a path cannot be.
    """
    validate(config)
    validate_options(options)
    config = resolve(config)
    run_dir = options.run_dir or run_directory.default_path(config)
    use_cache(options.cache_dir)
    run_directory.create(run_dir, config)
    with run_directory.locked(run_dir):
        return _run(config, options, run_dir, None)


def resume(config: Config, options: RunOptions) -> int:
    """Continue the run in `options.resume` from its newest whole checkpoint, as if it had never stopped.

    Returns as `train`. Raises ConfigError, naming both values, for a setting other than `total_steps` that differs from the
    run's, CheckpointError if no checkpoint can be loaded.
    """
    validate(config)
    validate_options(options)
    run_dir, config = options.resume, resolve(config)
    assert run_dir is not None
    if options.run_dir is not None:
        raise ConfigError(f"--run-dir {options.run_dir}: must be left out: --resume writes to {run_dir}")
    saved = run_directory.read_config(run_dir)
    allowed = {"total_steps"} | ({"physics"} if options.other_physics else set())
    for path, (ours, theirs) in differences(config, saved).items():
        if path not in allowed:
            raise ConfigError(f"{flag(path)} {ours}: must be {theirs} as in {run_dir}, or left out")
    if config.physics != saved.physics:
        print(f"from {saved.physics} to {config.physics}: steps differ by up to 1e-4, so this is not the run that would have been")
    use_cache(options.cache_dir)
    with run_directory.locked(run_dir):
        state = _last_state(run_dir, config)
        run_directory.write_json(run_dir / "config.json", to_dict(config))
        return _run(config, options, run_dir, state)


def _last_state(run_dir: Path, config: Config) -> TrainState | None:
    """From the newest whole checkpoint; None if the run stopped before its first."""
    if not any((run_dir / "checkpoints").glob("*.msgpack")):
        print(f"{run_dir} has no checkpoint yet: it starts again")
        return None
    state, path, wrong = checkpoint.newest(run_dir, config)
    for reason in wrong:
        print(f"{reason}; falling back", file=sys.stderr)
    print(f"resuming from {path.name}")
    return state


def _run(config: Config, options: RunOptions, run_dir: Path, state: TrainState | None) -> int:
    print(_budget(config))
    with Signals() as signals:
        state = _iterate(config, options, run_dir, signals, state)
    if _broken(state, options):
        reason = f"the last {int(state.failures.max())} updates were not finite and were left out"
        print(f"stopped: {reason}; the state before them is in {run_dir}", file=sys.stderr)
        return 1
    if signals.received:
        print(f"stopped by {signals.received.name}; continue with --resume {run_dir}", flush=True)
        return 128 + signals.received
    return _evaluate(state, config, options.episodes, run_dir)


def _broken(state: TrainState, options: RunOptions) -> bool:
    return int(state.failures.max()) >= options.max_nonfinite


def use_cache(cache_dir: str) -> None:
    """Keep compiled programs in `cache_dir`, or nowhere if it is "none"; raises ConfigError if it cannot be written."""
    if cache_dir == "none":
        jax.config.update("jax_enable_compilation_cache", False)
        return
    try:
        path = Path(cache_dir).expanduser()
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError) as reason:
        raise ConfigError(f"--cache-dir {cache_dir}: must be a directory that can be written, or none ({reason})") from reason
    jax.config.update("jax_compilation_cache_dir", str(path))


def _budget(config: Config) -> str:
    runs = f" × {config.num_seeds} seeds" if config.num_seeds > 1 else ""
    used = f"{config.iterations:,} iterations × {config.samples:,} samples = {config.iterations * config.samples:,}"
    return f"{config.env}-{config.env_version} {config.algo} on {config.physics}: {used} of {config.total_steps:,} steps{runs}"


def _iterate(config: Config, options: RunOptions, run_dir: Path, signals: Signals, state: TrainState | None) -> TrainState:
    """All iterations that are left, dispatch by dispatch, until the budget is used or a signal came."""
    trainer = make_trainer(make_task(config), CAPACITY)
    done = 0 if state is None else int(state.iteration[0])
    file = metrics.MetricsFile(run_dir / "metrics.jsonl", config, done)
    every = max(1, options.checkpoint_every // config.samples)
    began, count, first = time.monotonic() - file.seconds, 1, True
    reporter = Reporter(config.iterations * config.samples, config.num_seeds)
    try:
        state = trainer.init(config, seed_keys(config)) if state is None else state
        while done < config.iterations and (first or not signals.received):  # a signal while compiling still gets its checkpoint
            count = min(count, config.iterations - done, every - done % every)
            since = time.monotonic()
            state, measured = trainer.dispatch(config, state, count)
            new = file.append(measured, count, time.monotonic() - began)
            if options.debug_nonfinite:
                _save_incidents(state, new, run_dir / "nonfinite")
            seconds, done = (time.monotonic() - since) / count, done + count
            if not first:  # the first also compiled, so it says nothing about speed
                reporter.update(done * config.samples, config.samples / seconds, _mean_return(new, config))
            count = 1 if first else int(np.clip(DISPATCH_SECONDS / seconds, 1, CAPACITY))
            first, broken = False, _broken(state, options)
            if done % every == 0 or done == config.iterations or signals.received or broken:
                _save(state, file.rows, config, run_dir, done * config.samples)
            if broken:
                break
    finally:
        reporter.close()
    return state


def _mean_return(rows: list[dict[str, Any]], config: Config) -> float | None:
    returns = [row["episode_return"] for row in rows[-config.num_seeds :] if row["episode_return"] is not None]
    return float(np.mean(returns)) if returns else None


def _save(state: TrainState, rows: list[dict[str, Any]], config: Config, run_dir: Path, steps: int) -> None:
    checkpoint.save(run_dir / "checkpoints", state, steps)
    title = f"{config.env}-{config.env_version}, {config.algo}, {config.physics}"
    plots.save(plots.learning_curve(rows, title), run_dir / "curve.png")


def _save_incidents(state: TrainState, rows: list[dict[str, Any]], directory: Path) -> None:
    """The last state and action, per run and dispatch, from which a world turned non-finite: arrays 0, 1, … and action."""
    for seed in sorted({row["seed"] for row in rows if row["nonfinite"]}):
        world, action = jax.tree.map(lambda x, i=seed - rows[0]["seed"]: np.asarray(x[i]), state.episodes.incident)
        names = world._fields if isinstance(world, PhysicsState) else range(len(jax.tree.leaves(world)))
        directory.mkdir(exist_ok=True)
        arrays = {str(name): leaf for name, leaf in zip(names, jax.tree.leaves(world), strict=True)}
        np.savez(directory / f"steps_{rows[-1]['steps']:012d}_seed_{seed}.npz", **arrays, action=action)


def _evaluate(state: TrainState, config: Config, episodes: int, run_dir: Path) -> int:
    engine = "mjx" if config.env.startswith(BRAX) else "gymnasium"
    result = evaluate_state(state, config, engine=engine, episodes=episodes)
    run_directory.write_json(run_dir / "evaluation.json", result)
    print(f"{describe(result)}; files in {run_dir}", flush=True)
    return 0


def describe(result: dict[str, Any]) -> str:
    """An evaluation in one line."""
    return (
        f"return {result['return_mean']:,.1f} ± {result['return_std']:,.1f} over {result['episodes']} episodes"
        f" of the deterministic policy in {result['env']} ({result['engine']})"
    )
