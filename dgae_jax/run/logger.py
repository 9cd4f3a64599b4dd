"""Files of a run that grow: metrics, checkpoints, evaluations and the learning curve."""

import gc
import io
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.learn.build import policies_of
from dgae_jax.learn.types import TrainState
from dgae_jax.physics.engine import PhysicsState
from dgae_jax.run import checkpoint, files, metrics, runtime, terminal
from dgae_jax.run.evaluation import evaluate_policies
from dgae_jax.run.loggers import LoggerFeed
from dgae_jax.run.metrics import EvaluationsFile, MetricsFile
from dgae_jax.run.options import RunOptions
from dgae_jax.run.runtime import Stopped, Watch


class RunLogger:
    """The growing files of one run directory.

    Checkpoints and plots are written in a thread; a failure is raised by the next call.
    """

    def __init__(self, run_dir: Path, config: ResolvedConfig, options: RunOptions, done: int):
        """Open the files, new or continued behind `done` iterations."""
        self.run_dir, self.config, self.options = run_dir, config, options
        (run_dir / "checkpoints").mkdir(exist_ok=True)
        self.metrics = MetricsFile(run_dir / "metrics.jsonl", config, done)
        self.evaluations = EvaluationsFile(run_dir / "evaluations.jsonl")
        self.evaluations.cut(done * config.samples_per_iteration, config.num_seeds)
        names = options.log if jax.process_index() == 0 else ()
        self.feed = LoggerFeed(names, run_dir, config)
        self.page = terminal.Page(self.picture) if terminal.in_notebook() else None
        self.began = time.monotonic() - self.metrics.seconds
        self.thread, self.pending = ThreadPoolExecutor(1), Future()
        self.pending.set_result(None)

    def __enter__(self) -> "RunLogger":
        return self

    def __exit__(self, kind: Any, *_) -> None:
        self.thread.shutdown()
        self.feed.close(finished=kind is None)
        if kind is None or issubclass(kind, Stopped):
            self.pending.result()

    def _write(self, work: Callable, *args) -> None:
        self.pending.result()
        self.pending = self.thread.submit(work, *args)

    @property
    def steps(self) -> int:
        """Samples of each run so far."""
        return self.metrics.iteration * self.config.samples_per_iteration

    @property
    def evaluated(self) -> bool:
        """True if the state after so many samples was evaluated."""
        return self.evaluations.has(self.steps)

    def append(self, state: TrainState, measured: dict[str, Any], count: int) -> float | None:
        """Add `count` iterations to the metrics and return the last mean return, if any."""
        rows = self.metrics.append(measured, count, time.monotonic() - self.began)
        self.feed.log(rows)
        if self.options.debug_nonfinite:
            for seed in sorted({row["seed"] for row in rows if row["nonfinite"]}):
                self._save_incidents(state, seed)
        last = [row["episode_return"] for row in rows[-self.config.num_seeds :]]
        returns = [x for x in last if x is not None]
        return float(np.mean(returns)) if returns else None

    def save(self, state: TrainState) -> None:
        """Write a checkpoint from a copy: the state itself may be donated."""
        keep = self.options.keep_checkpoints, self.evaluations.best
        directory, arrays = self.run_dir / "checkpoints", checkpoint.arrays_of(state)
        self._write(checkpoint.save, directory, self.config, arrays, self.steps, *keep)

    def evaluate(self, state: TrainState, watch: Watch) -> dict[str, Any]:
        """Evaluate the policies and write and draw the result."""
        how = {"engine": self.options.eval_engine, "episodes": self.options.episodes}
        policies = runtime.gather(policies_of(state))
        result = evaluate_policies(policies, self.config, **how, watch=watch)
        if not self.evaluated:
            self.pending.result()  # the checkpoint is on the disk before its evaluation
            self.feed.log(self.evaluations.append(self.steps, result))
        self.draw()
        return result

    def draw(self) -> None:
        """Write the learning curve so far."""
        path, data = self.run_dir / "curve.png", self._curve()
        self._write(lambda: files.replace(path, _png(data)))

    def picture(self, text: str) -> bytes | None:
        """Return the learning curve so far with a text, None before the first return."""
        data = self._curve()
        return None if np.isnan(data[1]).all() else _png(data, text)

    def _curve(self) -> tuple[np.ndarray, np.ndarray, str, np.ndarray]:
        title = f"{self.config.task}, {self.config.algo}, {self.config.physics}"
        return *self.metrics.curve(), title, self.evaluations.points()

    def _save_incidents(self, state: TrainState, seed: int) -> None:
        """Write the last state and action from which each env of a seed turned non-finite."""
        index = seed - self.config.seed
        episodes = jax.tree.map(lambda x: x[index], runtime.gather(state.episodes))
        envs = np.flatnonzero(episodes.nonfinite)
        before, action = jax.tree.map(lambda x: x[envs], episodes.incident)
        leaves = jax.tree.leaves(before)
        names = before._fields if isinstance(before, PhysicsState) else range(len(leaves))
        arrays = {str(name): leaf for name, leaf in zip(names, leaves, strict=True)}
        path = self.run_dir / "nonfinite" / f"steps_{self.steps:012d}_seed_{seed}.npz"
        path.parent.mkdir(exist_ok=True)
        np.savez(path, env=envs, **arrays, action=action)


def _png(data: tuple, text: str = "") -> bytes:
    """Draw the learning curve, with a text below its title."""
    figure = metrics.learning_curve(*data)
    axes, image = figure.axes[0], io.BytesIO()
    if text:
        axes.set_title(f"{axes.get_title()}\n{text}", fontsize=9)
    figure.savefig(image, format="png")
    gc.collect()  # a figure is full of cycles: 3 MB each
    return image.getvalue()
