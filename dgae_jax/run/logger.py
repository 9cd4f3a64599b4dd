"""What a run leaves in its directory while it trains: metrics, checkpoints, evaluations, a curve."""

import gc
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.learn.build import InferenceState
from dgae_jax.learn.types import TrainState
from dgae_jax.physics.engine import PhysicsState
from dgae_jax.run import checkpoint, metrics, runtime, terminal
from dgae_jax.run.evaluation import evaluate_policies
from dgae_jax.run.loggers import Feed
from dgae_jax.run.metrics import EvaluationsFile, MetricsFile
from dgae_jax.run.options import RunOptions
from dgae_jax.run.runtime import Stopped, Watch

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class RunLogger:
    """The growing files of one run directory, begun anew or continued behind the iterations `done`.

    Checkpoints and plots are written beside the training, one after the other; a failure is raised by the call after.
    """

    def __init__(self, run_dir: Path, config: ResolvedConfig, options: RunOptions, done: int):
        self.run_dir, self.config, self.options = run_dir, config, options
        (run_dir / "checkpoints").mkdir(exist_ok=True)
        self.metrics = MetricsFile(run_dir / "metrics.jsonl", config, done)
        self.evaluations = EvaluationsFile(run_dir / "evaluations.jsonl")
        self.evaluations.cut(done * config.samples_per_iteration, config.num_seeds)
        self.feed = Feed(options.log if runtime.is_first() else (), run_dir, config, self.steps)
        self.page = terminal.Page(self.figure) if terminal.in_notebook() else None
        """Where the learning curve is shown as it grows."""
        self.began = time.monotonic() - self.metrics.seconds
        self.beside, self.pending = ThreadPoolExecutor(1), Future()
        self.pending.set_result(None)

    def __enter__(self) -> "RunLogger":
        return self

    def __exit__(self, kind: Any, *_) -> None:
        self.beside.shutdown()
        self.feed.close(finished=kind is None)
        if kind is None or issubclass(kind, Stopped):
            self.pending.result()

    def _write(self, file: Callable, *args) -> None:
        self.pending.result()
        self.pending = self.beside.submit(file, *args)

    @property
    def steps(self) -> int:
        """Samples of each run so far."""
        return self.metrics.iteration * self.config.samples_per_iteration

    @property
    def evaluated(self) -> bool:
        """Whether the state after so many samples was evaluated."""
        return self.evaluations.has(self.steps)

    def append(self, state: TrainState, measured: dict[str, Any], count: int) -> float | None:
        """Add `count` iterations to the metrics; the mean return of the last one, if there is any yet."""
        rows = self.metrics.append(measured, count, time.monotonic() - self.began)
        self.feed.rows(rows)
        if self.options.debug_nonfinite:
            self._save_incidents(state, {row["seed"] for row in rows if row["nonfinite"]})
        returns = [
            row["episode_return"]
            for row in rows[-self.config.num_seeds :]
            if row["episode_return"] is not None
        ]
        return float(np.mean(returns)) if returns else None

    def save(self, state: TrainState) -> None:
        """Write a checkpoint, from a copy: the state itself may be consumed meanwhile."""
        keep = self.options.keep_checkpoints, self.evaluations.best
        self._write(
            checkpoint.save,
            self.run_dir / "checkpoints",
            self.config,
            checkpoint.arrays_of(state),
            self.steps,
            *keep,
        )

    def evaluate(self, policies: InferenceState, watch: Watch) -> dict[str, Any]:
        """Returns of the policies as they are now, noted and drawn."""
        result = evaluate_policies(
            policies,
            self.config,
            engine=self.options.eval_engine,
            episodes=self.options.episodes,
            watch=watch,
        )
        if not self.evaluated:
            self.pending.result()  # no evaluation is on the disk without its checkpoint, from which the run goes on
            self.evaluations.append(self.steps, result)
            self.feed.evaluations([{"steps": self.steps, **one} for one in result["seeds"]])
        self.draw()
        return result

    def draw(self) -> None:
        """The learning curve so far."""
        self._write(_plot, self.run_dir / "curve.png", *self._curve())

    def figure(self) -> "Figure | None":
        """The learning curve so far, None before the first return."""
        data = self._curve()
        return None if np.isnan(data[1]).all() else metrics.learning_curve(*data)

    def _curve(self) -> tuple[np.ndarray, np.ndarray, str, np.ndarray]:
        title = f"{self.config.task}, {self.config.algo}, {self.config.physics}"
        return *self.metrics.curve(), title, self.evaluations.points()

    def _save_incidents(self, state: TrainState, seeds: set[int]) -> None:
        """Of every world that has turned non-finite the last state and action from which it did, per run: arrays by name."""
        for seed in sorted(seeds):
            episodes = jax.tree.map(
                lambda x, i=seed - self.config.seed: x[i], runtime.gather(state.episodes)
            )
            worlds = np.flatnonzero(episodes.nonfinite)
            world, action = jax.tree.map(lambda x, at=worlds: x[at], episodes.incident)
            names = (
                world._fields
                if isinstance(world, PhysicsState)
                else range(len(jax.tree.leaves(world)))
            )
            arrays = {
                str(name): leaf for name, leaf in zip(names, jax.tree.leaves(world), strict=True)
            }
            directory = self.run_dir / "nonfinite"
            directory.mkdir(exist_ok=True)
            np.savez(
                directory / f"steps_{self.steps:012d}_seed_{seed}.npz",
                world=worlds,
                **arrays,
                action=action,
            )


def _plot(path: Path, *data) -> None:
    metrics.save_figure(metrics.learning_curve(*data), path)
    gc.collect()  # a figure is full of cycles, and left alone figures gather: 3 MB each
