"""Metric loggers: TensorBoard, Weights & Biases and MLflow, one of their runs per seed.

A thread passes on the rows of `metrics.jsonl` and `evaluations.jsonl`, first those that a logger
lacks. `sinks.json` says how far each logger has come. A logger that fails costs one warning.
"""

import contextvars
import dataclasses
import os
import secrets
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from dgae_jax.configs.config import flat
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import to_dict
from dgae_jax.run import files, metrics, terminal

Rows = list[tuple[int, dict[str, float]]]
"""Samples and numbers by name, in the order of samples."""

MLFLOW_BATCH = 1000
"""Most metrics that MLflow takes in one request."""


class TensorBoard:
    """Event files in RUN_DIR/tensorboard/seed_N, one more each time that a run is resumed.

    They are written synchronously: tensorboardX's `SummaryWriter` hangs when the disk is full.
    """

    id = None

    def __init__(self, run_dir: Path, name: str, settings: dict[str, Any], run_id: str | None):
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.summary import text

        folder = run_dir / "tensorboard" / f"seed_{settings['seed']}"
        folder.mkdir(parents=True, exist_ok=True)
        self.writer = EventsWriter(str(folder / "events"))
        rows = [f"| {path} | {value} |" for path, value in settings.items()]
        table = "\n".join(["| setting | value |", "|---|---|", *rows])
        self._write(summary=text("configuration", table))

    def _write(self, **event) -> None:
        from tensorboardX.proto.event_pb2 import Event

        self.writer.write_event(Event(wall_time=time.time(), **event))

    def log(self, rows: Rows) -> None:
        """Write a scalar per number."""
        from tensorboardX.proto.summary_pb2 import Summary

        for steps, numbers in rows:
            values = [Summary.Value(tag=k, simple_value=x) for k, x in numbers.items()]
            self._write(step=steps, summary=Summary(value=values))
        self.writer.flush()

    def close(self, curve: Path | None, finished: bool) -> None:
        """Write the picture."""
        from matplotlib.image import imread
        from tensorboardX.summary import image

        if curve:
            self._write(summary=image(curve.name, imread(curve), dataformats="HWC"))
        self.writer.close()


class WeightsAndBiases:
    """Files in RUN_DIR/wandb, sent while the run trains where there is a login.

    WANDB_MODE, WANDB_PROJECT and WANDB_ENTITY keep their meaning.
    """

    def __init__(self, run_dir: Path, name: str, settings: dict[str, Any], run_id: str | None):
        import requests
        import wandb

        server = wandb.setup().settings.base_url
        chosen = os.environ.get("WANDB_MODE") or os.environ.get("WANDB_API_KEY")
        self.id = run_id or secrets.token_hex(4)
        self.run = wandb.init(
            dir=str(run_dir),
            project=os.environ.get("WANDB_PROJECT") or "dgae_jax",
            group=run_dir.resolve().name,
            name=name,
            id=self.id,
            resume="allow",
            # without a login wandb would ask for one
            mode=None if chosen or requests.utils.get_netrc_auth(server) else "offline",
            reinit="create_new",
            settings=wandb.Settings(silent=True, console="off"),
        )
        self.run.config.update(settings, allow_val_change=True)
        self.run.define_metric("*", step_metric="steps")
        if not self.run.offline:
            terminal.say(f"{name} at {self.run.url}")

    def log(self, rows: Rows) -> None:
        """Log the numbers; wandb's own step must grow, also from metrics to their evaluation."""
        for steps, numbers in rows:
            step = 2 * steps + ("iteration" not in numbers)
            self.run.log({"steps": steps, **numbers}, step=step)

    def close(self, curve: Path | None, finished: bool) -> None:
        """Log the picture, and finish."""
        import wandb

        if curve:
            self.run.log({curve.name: wandb.Image(str(curve))})
        self.run.finish(exit_code=0 if finished else 1)


class MLflow:
    """A SQLite store in RUN_DIR/mlflow, or the server that MLFLOW_TRACKING_URI names.

    MLflow refuses to write its older store of plain files. The picture is sent to a server only.
    """

    def __init__(self, run_dir: Path, name: str, settings: dict[str, Any], run_id: str | None):
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
        from mlflow import MlflowClient
        from mlflow.entities import Param

        self.server, folder = os.environ.get("MLFLOW_TRACKING_URI"), run_dir / "mlflow"
        if not self.server:
            folder.mkdir(exist_ok=True)
        self.client = MlflowClient(self.server or f"sqlite:///{folder.resolve() / 'mlflow.db'}")
        self.id: Any = run_id
        if self.id:
            self.client.update_run(self.id, status="RUNNING")
            return
        project = os.environ.get("MLFLOW_EXPERIMENT_NAME") or "dgae_jax"
        found = self.client.get_experiment_by_name(project)
        experiment = found.experiment_id if found else self.client.create_experiment(project)
        self.id = self.client.create_run(experiment, run_name=name).info.run_id
        params = [Param(path, str(value)) for path, value in settings.items()]
        self.client.log_batch(self.id, params=params)

    def log(self, rows: Rows) -> None:
        """Log the numbers."""
        from mlflow.entities import Metric

        now = round(1000 * time.time())
        entries = [Metric(k, x, now, steps) for steps, row in rows for k, x in row.items()]
        for i in range(0, len(entries), MLFLOW_BATCH):
            self.client.log_batch(self.id, metrics=entries[i : i + MLFLOW_BATCH])

    def close(self, curve: Path | None, finished: bool) -> None:
        """End the run."""
        if curve and self.server:
            self.client.log_artifact(self.id, str(curve))
        self.client.set_terminated(self.id, "FINISHED" if finished else "KILLED")


LOGGERS: dict[str, Callable[..., Any]] = {
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
    "mlflow": MLflow,
}
"""Loggers of one seed: made with the run directory, the name of their run, the configuration by
path, and the `id` that they had before."""


class LoggerFeed:
    """Feeds the loggers of one run in a thread; no method raises or waits but `close`."""

    def __init__(self, names: tuple[str, ...], run_dir: Path, config: ResolvedConfig):
        """Open the loggers, and pass on the rows that the run has so far."""
        self.run_dir, self.config = run_dir, config
        self.state = files.read_object(run_dir / "sinks.json") if names else {}
        self.open: dict[str, list[Any]] = {name: [] for name in names}
        self.thread, self.context = ThreadPoolExecutor(1, "loggers"), contextvars.copy_context()
        self._each(self._open)
        if names:
            rows = metrics.read(run_dir / "metrics.jsonl")
            rows += metrics.read(run_dir / "evaluations.jsonl")
            self.log(sorted(rows, key=lambda row: row["steps"]))

    def log(self, rows: list[dict[str, Any]]) -> None:
        """Pass on rows of either file, in the order of steps."""
        self._each(self._log, rows)

    def close(self, finished: bool) -> None:
        """Wait until all is written; `finished` if the run reached its end."""
        self._each(self._close, finished)
        self.thread.shutdown()

    def _each(self, work: Callable[..., Any], *args) -> None:
        self.thread.submit(self.context.run, self._try, work, *args)  # as quiet there as here

    def _try(self, work: Callable[..., Any], *args) -> None:
        for name in tuple(self.open):
            try:
                work(name, *args)
            except Exception as reason:  # a library, a network or a disk is not worth the run
                self.open.pop(name, None)
                why = f"{type(reason).__name__}: {reason}".strip().partition("\n")[0][:300]
                rest = "the run continues, and --resume adds what is missing"
                terminal.warn(f"warning: --log {name} stops here ({why}); {rest}")

    def _open(self, name: str) -> None:
        state = {"ids": {}, "rows": 0, "evaluations": 0} | self.state.get(name, {})
        self.state[name], count = state, self.config.num_seeds
        for seed in range(self.config.seed, self.config.seed + count):
            title = self.run_dir.resolve().name + (f"-seed-{seed}" if count > 1 else "")
            values = flat(to_dict(dataclasses.replace(self.config, seed=seed)))
            settings = {path: value for path, value in values.items() if value is not None}
            logger = LOGGERS[name](self.run_dir, title, settings, state["ids"].get(str(seed)))
            self.open[name].append(logger)
            state["ids"][str(seed)] = logger.id

    def _log(self, name: str, rows: list[dict[str, Any]]) -> None:
        state = self.state[name]
        new = [row for row in rows if row["steps"] > state[_file(row)]]
        for seed, logger in enumerate(self.open[name], self.config.seed):
            logger.log([(row["steps"], _numbers(row)) for row in new if row["seed"] == seed])
        state |= {_file(row): row["steps"] for row in new}
        files.write_json(self.run_dir / "sinks.json", self.state)

    def _close(self, name: str, finished: bool) -> None:
        curve = self.run_dir / "curve.png"
        for logger in self.open.pop(name):
            logger.close(curve if curve.exists() else None, finished)


def _file(row: dict[str, Any]) -> str:
    """Return the name in `sinks.json` of the file that a row is in."""
    return "rows" if "iteration" in row else "evaluations"


def _numbers(row: dict[str, Any]) -> dict[str, float]:
    if "iteration" not in row:
        row = {f"evaluation/{name}": row[name] for name in ("return_mean", "return_std")}
    left_out = "steps", "seed"
    return {k: float(x) for k, x in row.items() if x is not None and k not in left_out}
