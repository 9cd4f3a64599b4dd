"""Files of a run that grow: metrics, checkpoints, evaluations and the learning curve."""

import gc
import io
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.learn.build import policies_of
from dgae_jax.learn.types import TrainState
from dgae_jax.run import checkpoint, files, metrics, runtime, terminal
from dgae_jax.run.evaluation import evaluate_policies
from dgae_jax.run.loggers import LoggerFeed
from dgae_jax.run.metrics import EvaluationsFile, MetricsFile
from dgae_jax.run.options import RunOptions
from dgae_jax.run.runtime import Watch


class RunLogger:
    """The growing files of one run directory."""

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

    def __enter__(self) -> "RunLogger":
        return self

    def __exit__(self, kind: Any, *_) -> None:
        self.feed.close(finished=kind is None)

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
        """Write a checkpoint and the learning curve so far."""
        keep = self.options.keep_checkpoints, self.evaluations.best
        directory, arrays = self.run_dir / "checkpoints", checkpoint.arrays_of(state)
        checkpoint.save(directory, self.config, arrays, self.steps, *keep)
        files.replace(self.run_dir / "curve.png", self._png())

    def evaluate(self, state: TrainState, watch: Watch) -> dict[str, Any]:
        """Evaluate the policies and write and draw the result."""
        how = {"engine": self.options.eval_engine, "episodes": self.options.episodes}
        policies = runtime.gather(policies_of(state))
        result = evaluate_policies(policies, self.config, **how, watch=watch)
        if not self.evaluated:
            self.feed.log(self.evaluations.append(self.steps, result))
        files.replace(self.run_dir / "curve.png", self._png())
        return result

    def picture(self, text: str) -> bytes | None:
        """Return the learning curve so far with a text, None before the first return."""
        return None if np.isnan(self.metrics.returns).all() else self._png(text)

    def _png(self, text: str = "") -> bytes:
        title = f"{self.config.task}, {self.config.algo}, {self.config.physics}"
        data = *self.metrics.curve(), title, self.evaluations.points()
        figure, image = metrics.learning_curve(*data), io.BytesIO()
        if text:
            figure.axes[0].set_title(f"{title}\n{text}", fontsize=9)
        figure.savefig(image, format="png")
        gc.collect()  # a figure is full of cycles: 3 MB each
        return image.getvalue()

    def _save_incidents(self, state: TrainState, seed: int) -> None:
        """Write the last state and action from which each env of a seed turned non-finite."""
        index = seed - self.config.seed
        episodes = jax.tree.map(lambda x: x[index], runtime.gather(state.episodes))
        envs = np.flatnonzero(episodes.nonfinite)
        before, action = jax.tree.map(lambda x: x[envs], episodes.incident)
        arrays = {**checkpoint.arrays_of(before), "env": envs, "action": action}
        path = self.run_dir / "nonfinite" / f"steps_{self.steps:012d}_seed_{seed}.npz"
        path.parent.mkdir(exist_ok=True)
        np.savez(path, **arrays)
