"""Metric loggers: TensorBoard, Weights & Biases and MLflow, one of their runs per seed.

`sinks.json` in the run directory says how far each has come: after a resume a logger gets the rows
that it lacks, and none twice. A logger that fails costs one warning.
"""

import contextvars
import dataclasses
import itertools
import math
import os
import secrets
import socket
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from urllib.parse import unquote, urlsplit

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import flat, to_dict
from dgae_jax.run import files, terminal
from dgae_jax.run.metrics import EvaluationsFile

ITERATIONS = 256
"""Most iterations that are read at once."""

MEDIA = ("curve.png", "video.mp4", "video.gif")
"""Files of the run directory that loggers get at the end."""

CONNECT_SECONDS = 3.0
"""Wait for the server of Weights & Biases before the run stays offline."""

MLFLOW_BATCH = 1000
"""Most metrics that MLflow takes in one request."""


class Place(NamedTuple):
    """A run directory, its configuration, and how far a logger has come."""

    run_dir: Path
    config: ResolvedConfig
    ids: dict[str, str]
    """Ids of the logger's runs by seed; empty at first, kept in the run directory."""
    steps: int
    """Samples up to which the logger has the metrics."""

    @property
    def seeds(self) -> range:
        """The trained seeds."""
        return range(self.config.seed, self.config.seed + self.config.num_seeds)

    def name(self, seed: int) -> str:
        """Return the name of the run of one seed."""
        directory = self.run_dir.resolve().name
        return directory if self.config.num_seeds == 1 else f"{directory}-seed-{seed}"

    def hyperparameters(self, seed: int) -> dict[str, Any]:
        """Return the set values of one seed's configuration by path."""
        values = flat(to_dict(dataclasses.replace(self.config, seed=seed)))
        return {path: value for path, value in values.items() if value is not None}


class Entry(NamedTuple):
    """The finite numbers of one row of `metrics.jsonl` or `evaluations.jsonl`."""

    seed: int
    steps: int
    seconds: float | None
    """Time since the run began; None for an evaluation."""
    values: dict[str, float]


class MetricLogger(Protocol):
    """A logger that is open for one run directory; what it raises gives the logger up."""

    def log(self, entries: list[Entry]) -> None:
        """Take entries in their order, of all seeds."""

    def close(self, paths: list[Path], finished: bool) -> None:
        """Take pictures and videos, and end; `finished` if the run reached its end."""


def _entry(part: str, row: dict[str, Any]) -> Entry:
    if part == "rows":
        values = {name: x for name, x in row.items() if name not in ("steps", "seed")}
    else:
        values = {f"evaluation/{name}": row[name] for name in ("return_mean", "return_std")}
    there = {k: float(x) for k, x in values.items() if x is not None and math.isfinite(x)}
    return Entry(row["seed"], row["steps"], row.get("seconds"), there)


def _batches(items: Iterable[Any], size: int) -> Iterator[list[Any]]:
    left = iter(items)
    return iter(lambda: list(itertools.islice(left, size)), [])


class TensorBoard:
    """Event files in RUN_DIR/tensorboard/seed_N, one more each time that a run is resumed.

    They are written synchronously: tensorboardX's `SummaryWriter` hangs when the disk is full.
    """

    def __init__(self, place: Place):
        """Open a new event file per seed, which hides later steps of older ones."""
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import SessionLog
        from tensorboardX.summary import text

        self.writers = {}
        for seed in place.seeds:
            folder = place.run_dir / "tensorboard" / f"seed_{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            number = f".{len(list(folder.iterdir()))}"  # a name of its own also within a second
            self.writers[seed] = EventsWriter(str(folder / "events"), number)
            start = SessionLog(status=SessionLog.START)
            self._write(seed, step=place.steps + 1, session_log=start)
            values = place.hyperparameters(seed).items()
            table = ["| setting | value |", "|---|---|", *(f"| {k} | {v} |" for k, v in values)]
            self._write(seed, summary=text("configuration", "\n".join(table)))
        self._flush()

    def _write(self, seed: int, **event) -> None:
        from tensorboardX.proto.event_pb2 import Event

        self.writers[seed].write_event(Event(wall_time=time.time(), **event))

    def _flush(self) -> None:
        for writer in self.writers.values():
            writer.flush()

    def log(self, entries: list[Entry]) -> None:
        """Write a scalar per number."""
        from tensorboardX.proto.summary_pb2 import Summary

        for entry in entries:
            values = [Summary.Value(tag=k, simple_value=x) for k, x in entry.values.items()]
            self._write(entry.seed, step=entry.steps, summary=Summary(value=values))
        self._flush()

    def close(self, paths: list[Path], finished: bool) -> None:
        """Write the PNGs as they are, with the size in their header."""
        from tensorboardX.proto.summary_pb2 import Summary

        images = []
        for path in (path for path in paths if path.suffix == ".png"):
            data = path.read_bytes()
            width, height = struct.unpack(">II", data[16:24])
            size: dict[str, Any] = {"width": width, "height": height, "colorspace": 4}
            image = Summary.Image(encoded_image_string=data, **size)
            images.append(Summary.Value(tag=path.name, image=image))
        for seed, writer in self.writers.items():
            self._write(seed, summary=Summary(value=images))
            writer.close()


class WeightsAndBiases:
    """Files in RUN_DIR/wandb, sent while the run trains where there is a login and a network.

    Its own step counter, which only grows, has two numbers per sample count: the metrics' and the
    evaluation's. WANDB_MODE, WANDB_PROJECT and WANDB_ENTITY keep their meaning.
    """

    def __init__(self, place: Place):
        """Start or continue the run of each seed."""
        import wandb

        mode, self.last, self.runs = _wandb_mode(), place.steps, {}
        for seed in place.seeds:
            run = self.runs[seed] = wandb.init(
                dir=str(place.run_dir),
                project=os.environ.get("WANDB_PROJECT") or "dgae_jax",
                group=place.run_dir.resolve().name,
                name=place.name(seed),
                id=place.ids.setdefault(str(seed), secrets.token_hex(4)),
                resume=None if mode == "offline" else "allow",
                mode=mode,
                reinit="create_new",
                settings=wandb.Settings(silent=True, console="off"),
            )
            run.config.update(place.hyperparameters(seed), allow_val_change=True)
            run.define_metric("*", step_metric="steps")
            if mode == "online":
                terminal.say(f"{place.name(seed)} at {run.url}")

    def log(self, entries: list[Entry]) -> None:
        """Log the numbers over samples."""
        for entry in entries:
            self.last, evaluation = max(self.last, entry.steps), entry.seconds is None
            values = {"steps": entry.steps, **entry.values}
            self.runs[entry.seed].log(values, step=2 * entry.steps + evaluation)

    def close(self, paths: list[Path], finished: bool) -> None:
        """Log images and videos, and finish."""
        import wandb

        for run in self.runs.values():
            kinds = {path: wandb.Image if path.suffix == ".png" else wandb.Video for path in paths}
            if media := {path.name: kind(str(path)) for path, kind in kinds.items()}:
                run.log(media, step=2 * self.last + 2)
            run.finish(exit_code=0 if finished else 1)


def _wandb_mode() -> Any:
    """Return the user's mode; without one online if there is a login and a server: no prompts."""
    import wandb
    from requests.utils import get_environ_proxies, get_netrc_auth, select_proxy

    chosen = wandb.setup().settings
    if os.environ.get("WANDB_MODE") or chosen.mode != "online":
        return chosen.mode
    server = chosen.base_url
    keys = ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE")
    if not (any(map(os.environ.get, keys)) or get_netrc_auth(server)):
        return "offline"
    address = urlsplit(select_proxy(server, get_environ_proxies(server)) or server)
    port = address.port or {"http": 80}.get(address.scheme, 443)
    try:
        socket.create_connection((address.hostname, port), CONNECT_SECONDS).close()
    except OSError:
        return "offline"
    return "online"


class MLflow:
    """A SQLite store in RUN_DIR/mlflow, or the server that MLFLOW_TRACKING_URI names.

    MLflow refuses to write its older store of plain files. The times of metrics are those of the
    run, so that a row that is given twice is one.
    """

    def __init__(self, place: Place):
        """Start or continue the run of each seed."""
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
        from mlflow import MlflowClient

        self.run_dir, self.server = place.run_dir, os.environ.get("MLFLOW_TRACKING_URI")
        self.folder = (place.run_dir / "mlflow").resolve()
        if not self.server:
            self.folder.mkdir(exist_ok=True)
        self.client = MlflowClient(self.server or f"sqlite:///{self.folder / 'mlflow.db'}")
        self.runs = {seed: self._run(place, seed) for seed in place.seeds}
        for run in self.runs.values():
            self._keep(run, [place.run_dir / "config.json"])

    def _run(self, place: Place, seed: int):
        from mlflow.entities import Param

        known = place.ids.get(str(seed))
        if known:
            self.client.update_run(known, status="RUNNING")
        else:
            run = self.client.create_run(self._experiment(), run_name=place.name(seed))
            place.ids[str(seed)] = known = run.info.run_id
            pairs = place.hyperparameters(seed).items()
            self.client.log_batch(known, params=[Param(name, str(x)) for name, x in pairs])
        return self.client.get_run(known)

    def _experiment(self) -> str:
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME") or "dgae_jax"
        if found := self.client.get_experiment_by_name(name):
            return found.experiment_id
        own = None if self.server else (self.folder / "files").as_uri()
        return self.client.create_experiment(name, artifact_location=own)

    def log(self, entries: list[Entry]) -> None:
        """Log the numbers at the times of the run."""
        from mlflow.entities import Metric

        for seed, run in self.runs.items():
            metrics = []
            for entry in (entry for entry in entries if entry.seed == seed):
                past = None if entry.seconds is None else 1000 * entry.seconds
                at = round(1000 * time.time() if past is None else run.info.start_time + past)
                metrics += [Metric(k, x, at, entry.steps) for k, x in entry.values.items()]
            for some in _batches(metrics, MLFLOW_BATCH):
                self.client.log_batch(run.info.run_id, metrics=some, synchronous=True)

    def close(self, paths: list[Path], finished: bool) -> None:
        """Keep the files and end the runs."""
        for run in self.runs.values():
            self._keep(run, paths)
            status = "FINISHED" if finished else "KILLED"
            self.client.set_terminated(run.info.run_id, status)

    def _keep(self, run, paths: list[Path]) -> None:
        """Log files, unless the store lies elsewhere since its directory was moved."""
        kept = urlsplit(run.info.artifact_uri)
        here = Path(unquote(kept.path)).is_relative_to(self.run_dir.resolve())
        if kept.scheme != "file" or here:
            for path in paths:
                self.client.log_artifact(run.info.run_id, str(path))


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
        self.run_dir, self.config = run_dir, config
        self.path = run_dir / "sinks.json"
        found = files.read_object(self.path) if names else {}
        self.state = {name: _progress(found.get(name)) for name in LOGGERS if name in found}
        self.open: dict[str, MetricLogger] = {}
        self.thread, self.context = ThreadPoolExecutor(1, "loggers"), contextvars.copy_context()
        for name in names:
            self._later(self._try, name, self._open, done)

    def log(self, part: str, rows: list[dict[str, Any]]) -> None:
        """Log `rows` of metrics, all seeds of each iteration, or `evaluations`."""
        self._each(self._give, part, rows)

    def close(self, finished: bool) -> None:
        """Wait until all is written; `finished` if the run reached its end."""
        self._each(self._close, finished)
        self.thread.shutdown()

    def _each(self, work: Callable[..., None], *args) -> None:
        def all_open() -> None:
            for name in tuple(self.open):
                self._try(name, work, *args)

        self._later(all_open)

    def _later(self, work: Callable[..., None], *args) -> None:
        self.thread.submit(self.context.run, work, *args)  # it is as quiet there as here

    def _try(self, name: str, work: Callable[..., None], *args) -> None:
        try:
            work(name, *args)
        except Exception as reason:  # a library, a network or a disk is not worth the run
            self.open.pop(name, None)
            why = f"{type(reason).__name__}: {reason}".strip().partition("\n")[0][:300]
            rest = "the run continues, and --resume adds what is missing"
            terminal.warn(f"warning: --log {name} stops here ({why}); {rest}")

    def _open(self, name: str, done: int) -> None:
        state = self.state.setdefault(name, _progress({}))
        if name in REWINDS:
            kept = min(done, state["rows"])
            state |= {"rows": kept, "evaluations": min(kept, state["evaluations"])}
        self.open[name] = LOGGERS[name](
            Place(self.run_dir, self.config, state["ids"], state["rows"])
        )
        files.write_json(self.path, self.state)
        rows = (row for row, _ in files.whole_rows(self.run_dir / "metrics.jsonl"))
        known = (row for row in rows if row["steps"] <= done)
        for chunk in _batches(known, ITERATIONS * self.config.num_seeds):
            self._give(name, "rows", chunk)
        evaluations = EvaluationsFile(self.run_dir / "evaluations.jsonl").rows
        self._give(name, "evaluations", [row for row in evaluations if row["steps"] <= done])

    def _give(self, name: str, part: str, rows: list[dict[str, Any]]) -> None:
        """Pass on those of the rows that the logger lacks."""
        state = self.state[name]
        if new := [row for row in rows if row["steps"] > state[part]]:
            self.open[name].log([_entry(part, row) for row in new])
            state[part] = new[-1]["steps"]
            files.write_json(self.path, self.state)

    def _close(self, name: str, finished: bool) -> None:
        media = [self.run_dir / each for each in MEDIA]
        self.open.pop(name).close([path for path in media if path.exists()], finished)


def _progress(found: Any) -> dict[str, Any]:
    """Return how far a logger has come; what cannot be understood counts as nothing."""
    found = found if isinstance(found, dict) else {}
    ids = found.get("ids") if isinstance(found.get("ids"), dict) else {}

    def steps(part: str) -> int:
        at = found.get(part)
        return at if type(at) is int and at >= 0 else 0

    known = {seed: each for seed, each in ids.items() if isinstance(each, str)}
    return {"ids": known, "rows": steps("rows"), "evaluations": steps("evaluations")}
