"""Metric loggers: TensorBoard, Weights & Biases and MLflow, one of their runs per seed.

A thread passes on the rows of `metrics.jsonl` and `evaluations.jsonl` that a logger lacks, at the
start, after each dispatch and at the end. `sinks.json` says how far each logger has come. A logger
that fails costs one warning.
"""

import contextvars
import dataclasses
import os
import secrets
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import flat, to_dict
from dgae_jax.run import files, terminal

FILES = {"rows": "metrics.jsonl", "evaluations": "evaluations.jsonl"}
"""Files of the run directory that are logged, by their names in `sinks.json`."""

CONNECT_SECONDS = 3.0
"""Wait for the server of Weights & Biases before the run stays offline."""

MLFLOW_BATCH = 1000
"""Most metrics that MLflow takes in one request."""


class Place(NamedTuple):
    """One seed of a run directory, and how far a logger has come."""

    run_dir: Path
    name: str
    seed: int
    settings: dict[str, Any]
    """The seed's configuration as far as it is set, by path."""
    id: str | None
    """The logger's id of its run, kept in the run directory; None at first."""
    steps: int
    """Samples up to which the logger has the metrics."""


class Entry(NamedTuple):
    """The numbers of one row of `metrics.jsonl` or `evaluations.jsonl`."""

    seed: int
    steps: int
    seconds: float | None
    """Time since the run began; None for an evaluation."""
    values: dict[str, float]


class MetricLogger(Protocol):
    """A logger of one seed, opened with its `Place`; what it raises gives the logger up."""

    id: str | None

    def log(self, entries: list[Entry]) -> None:
        """Take entries in the order of steps."""

    def close(self, curve: Path | None, finished: bool) -> None:
        """Take the learning curve, if any, and end; `finished` if the run reached its end."""


class TensorBoard:
    """Event files in RUN_DIR/tensorboard/seed_N, one more each time that a run is resumed.

    They are written synchronously: tensorboardX's `SummaryWriter` hangs when the disk is full.
    """

    id: str | None = None

    def __init__(self, place: Place):
        """Open a new event file, which hides later steps of older ones."""
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import SessionLog
        from tensorboardX.summary import text

        folder = place.run_dir / "tensorboard" / f"seed_{place.seed}"
        folder.mkdir(parents=True, exist_ok=True)
        number = f".{len(list(folder.iterdir()))}"  # a name of its own also within a second
        self.writer = EventsWriter(str(folder / "events"), number)
        self._write(step=place.steps + 1, session_log=SessionLog(status=SessionLog.START))
        rows = [f"| {name} | {value} |" for name, value in place.settings.items()]
        table = "\n".join(["| setting | value |", "|---|---|", *rows])
        self._write(summary=text("configuration", table))

    def _write(self, **event) -> None:
        from tensorboardX.proto.event_pb2 import Event

        self.writer.write_event(Event(wall_time=time.time(), **event))

    def log(self, entries: list[Entry]) -> None:
        """Write a scalar per number."""
        from tensorboardX.proto.summary_pb2 import Summary

        for entry in entries:
            values = [Summary.Value(tag=k, simple_value=x) for k, x in entry.values.items()]
            self._write(step=entry.steps, summary=Summary(value=values))
        self.writer.flush()

    def close(self, curve: Path | None, finished: bool) -> None:
        """Write the picture."""
        from matplotlib.image import imread
        from tensorboardX.summary import image

        if curve:
            self._write(summary=image(curve.name, imread(curve), dataformats="HWC"))
        self.writer.close()


class WeightsAndBiases:
    """Files in RUN_DIR/wandb, sent while the run trains where there is a login and a network.

    Its own step counter, which only grows, has two numbers per sample count: the metrics' and the
    evaluation's. WANDB_MODE, WANDB_PROJECT and WANDB_ENTITY keep their meaning.
    """

    def __init__(self, place: Place):
        """Start or continue the run."""
        import wandb

        mode, self.last = _wandb_mode(), place.steps
        self.id: str | None = place.id or secrets.token_hex(4)
        self.run = wandb.init(
            dir=str(place.run_dir),
            project=os.environ.get("WANDB_PROJECT") or "dgae_jax",
            group=place.run_dir.resolve().name,
            name=place.name,
            id=self.id,
            resume=None if mode == "offline" else "allow",
            mode=mode,
            reinit="create_new",
            settings=wandb.Settings(silent=True, console="off"),
        )
        self.run.config.update(place.settings, allow_val_change=True)
        self.run.define_metric("*", step_metric="steps")
        if mode == "online":
            terminal.say(f"{place.name} at {self.run.url}")

    def log(self, entries: list[Entry]) -> None:
        """Log the numbers over samples."""
        for entry in entries:
            self.last, evaluation = max(self.last, entry.steps), entry.seconds is None
            values = {"steps": entry.steps, **entry.values}
            self.run.log(values, step=2 * entry.steps + evaluation)

    def close(self, curve: Path | None, finished: bool) -> None:
        """Log the picture, and finish."""
        import wandb

        if curve:
            self.run.log({curve.name: wandb.Image(str(curve))}, step=2 * self.last + 2)
        self.run.finish(exit_code=0 if finished else 1)


def _wandb_mode() -> Any:
    """Return the user's mode; without one online if there is a login and a server: no prompts."""
    import requests
    import wandb

    chosen = wandb.setup().settings
    if os.environ.get("WANDB_MODE") or chosen.mode != "online":
        return chosen.mode
    keys = ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE")
    if not (any(map(os.environ.get, keys)) or requests.utils.get_netrc_auth(chosen.base_url)):
        return "offline"
    try:
        requests.head(chosen.base_url, timeout=CONNECT_SECONDS)
    except requests.RequestException:
        return "offline"
    return "online"


class MLflow:
    """A SQLite store in RUN_DIR/mlflow, or the server that MLFLOW_TRACKING_URI names.

    MLflow refuses to write its older store of plain files. The times of metrics are those of the
    run, so that a row that is given twice is one. The picture is sent to a server only.
    """

    def __init__(self, place: Place):
        """Start or continue the run."""
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
        from mlflow import MlflowClient
        from mlflow.entities import Param

        self.server, folder = os.environ.get("MLFLOW_TRACKING_URI"), place.run_dir / "mlflow"
        if not self.server:
            folder.mkdir(exist_ok=True)
        self.client = MlflowClient(self.server or f"sqlite:///{folder.resolve() / 'mlflow.db'}")
        self.id: Any = place.id
        if self.id:
            self.client.update_run(self.id, status="RUNNING")
        else:
            name = os.environ.get("MLFLOW_EXPERIMENT_NAME") or "dgae_jax"
            found = self.client.get_experiment_by_name(name)
            experiment = found.experiment_id if found else self.client.create_experiment(name)
            self.id = self.client.create_run(experiment, run_name=place.name).info.run_id
            params = [Param(path, str(value)) for path, value in place.settings.items()]
            self.client.log_batch(self.id, params=params)
        self.began = self.client.get_run(self.id).info.start_time

    def log(self, entries: list[Entry]) -> None:
        """Log the numbers at the times of the run."""
        from mlflow.entities import Metric

        metrics = []
        for entry in entries:
            past = None if entry.seconds is None else self.began + 1000 * entry.seconds
            at = round(1000 * time.time() if past is None else past)
            metrics += [Metric(k, x, at, entry.steps) for k, x in entry.values.items()]
        for i in range(0, len(metrics), MLFLOW_BATCH):
            some = metrics[i : i + MLFLOW_BATCH]
            self.client.log_batch(self.id, metrics=some, synchronous=True)

    def close(self, curve: Path | None, finished: bool) -> None:
        """End the run."""
        if curve and self.server:
            self.client.log_artifact(self.id, str(curve))
        self.client.set_terminated(self.id, "FINISHED" if finished else "KILLED")


LOGGERS: dict[str, Callable[[Place], MetricLogger]] = {
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
    "mlflow": MLflow,
}

REWINDS = ("tensorboard",)
"""Loggers that can take back what followed the checkpoint; others keep it, and get it once."""


class LoggerFeed:
    """Feeds the loggers of one run in a thread; no method raises or waits but `close`."""

    def __init__(self, names: tuple[str, ...], run_dir: Path, config: ResolvedConfig, done: int):
        """Open the loggers; `done` are the samples of each run in its files so far."""
        self.run_dir, self.config, self.done = run_dir, config, done
        self.path = run_dir / "sinks.json"
        self.state = files.read_object(self.path) if names else {}
        self.open: dict[str, dict[int, MetricLogger]] = {name: {} for name in names}
        self.known: dict[str, dict[str, Any]] = {}
        """How far each logger had come when it was opened; `read` are offsets since then."""
        self.read: dict[tuple[str, str], int] = {}
        self.thread, self.context = ThreadPoolExecutor(1, "loggers"), contextvars.copy_context()
        self.update()

    def update(self) -> None:
        """Log the rows that the run's files have by now."""
        self._each(self._catch_up)

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

    def _catch_up(self, name: str) -> None:
        """Pass on the rows that a logger lacks, in the order of steps; open it first."""
        loggers = self.open[name] = self.open[name] or self._opened(name)
        new, reached = [], {}
        for part, file in FILES.items():  # evaluations last: the disk has those of all rows before
            rows = files.whole_rows(self.run_dir / file, self.read.get((name, part), 0))
            for row, self.read[name, part] in rows:
                if row["steps"] > self.known[name][part]:
                    new.append(_entry(part, row))
                    reached[part] = row["steps"]
        if new:
            new.sort(key=lambda entry: entry.steps)
            for seed, logger in loggers.items():
                logger.log([entry for entry in new if entry.seed == seed])
            self.state[name] |= reached
            files.write_json(self.path, self.state)

    def _opened(self, name: str) -> dict[int, MetricLogger]:
        state = {"ids": {}, "rows": 0, "evaluations": 0} | self.state.get(name, {})
        if name in REWINDS:
            state |= {part: min(self.done, state[part]) for part in FILES}
        self.state[name], self.known[name] = state, dict(state)
        loggers, count = {}, self.config.num_seeds
        for seed in range(self.config.seed, self.config.seed + count):
            title = self.run_dir.resolve().name + (f"-seed-{seed}" if count > 1 else "")
            values = flat(to_dict(dataclasses.replace(self.config, seed=seed)))
            settings = {path: value for path, value in values.items() if value is not None}
            known = state["ids"].get(str(seed)), state["rows"]
            loggers[seed] = LOGGERS[name](Place(self.run_dir, title, seed, settings, *known))
            state["ids"][str(seed)] = loggers[seed].id
        files.write_json(self.path, self.state)
        return loggers

    def _close(self, name: str, finished: bool) -> None:
        self._catch_up(name)
        curve = self.run_dir / "curve.png"
        for logger in self.open.pop(name).values():
            logger.close(curve if curve.exists() else None, finished)


def _entry(part: str, row: dict[str, Any]) -> Entry:
    if part == "rows":
        values = {name: x for name, x in row.items() if name not in ("steps", "seed")}
    else:
        values = {f"evaluation/{name}": row[name] for name in ("return_mean", "return_std")}
    there = {name: float(x) for name, x in values.items() if x is not None}
    return Entry(row["seed"], row["steps"], row.get("seconds"), there)
