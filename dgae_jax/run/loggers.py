"""What a sink is: where the metrics of a run go beside its own files."""

import contextvars
import dataclasses
import itertools
import json
import math
import os
import secrets
import socket
import struct
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import flat, to_dict
from dgae_jax.run import files, terminal
from dgae_jax.run.metrics import EvaluationsFile

Row = dict[str, Any]
"""A row of `metrics.jsonl` or of `evaluations.jsonl`: `steps`, `seed`, and numbers by name, None where there is none."""


class Place(NamedTuple):
    """What a sink is opened with."""

    run_dir: Path
    config: ResolvedConfig
    ids: dict[str, str]
    """By seed, how the viewer calls its run; empty at first, kept in the run directory from then on."""
    kept: int
    """Samples of each run up to which the sink has the metrics; what one that goes back has of later ones is not to be seen."""


class MetricLogger(NamedTuple):
    """Open to one run directory; each of its functions may raise anything, which gives the sink up."""

    rows: Callable[[list[Row]], None]
    """Take rows of metrics, in their order: all seeds of each iteration."""
    evaluations: Callable[[list[Row]], None]
    """Take the evaluations of all seeds."""
    close: Callable[[list[Path], bool], None]
    """Take pictures and films, and end; told whether the run reached its end."""


def seeds_of(config: ResolvedConfig) -> range:
    """The seeds that a run trains side by side: one run of the viewer each."""
    return range(config.seed, config.seed + config.num_seeds)


def name_of(place: Place, seed: int) -> str:
    """How the run of one seed is shown."""
    directory = place.run_dir.resolve().name
    return directory if place.config.num_seeds == 1 else f"{directory}-seed-{seed}"


def settings(config: ResolvedConfig, seed: int) -> dict[str, Any]:
    """What the run of one seed was configured by: values by path, those that are unset left out."""
    return {
        path: value
        for path, value in flat(to_dict(dataclasses.replace(config, seed=seed))).items()
        if value is not None
    }


def numbers(row: Row) -> dict[str, float]:
    """The metrics of a row that exist."""
    return _finite({name: value for name, value in row.items() if name not in ("steps", "seed")})


def scores(row: Row) -> dict[str, float]:
    """The numbers of an evaluation of one seed that exist."""
    return _finite({f"evaluation/{name}": row[name] for name in ("return_mean", "return_std")})


def _finite(values: dict[str, Any]) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in values.items()
        if value is not None and math.isfinite(value)
    }


def tensorboard_logger(place: Place) -> MetricLogger:
    """A new event file per seed; what an older one has of later steps than `place.kept` is hidden by the viewer from then on."""
    from tensorboardX.proto.event_pb2 import Event, SessionLog
    from tensorboardX.proto.summary_pb2 import Summary
    from tensorboardX.summary import text

    writers = {
        seed: _writer(place.run_dir / "tensorboard" / f"seed_{seed}")
        for seed in seeds_of(place.config)
    }

    def write(seed: int, **event) -> None:
        writers[seed].write_event(Event(wall_time=time.time(), **event))

    def scalars(seed: int, steps: int, values: dict[str, float]) -> None:
        write(
            seed,
            step=steps,
            summary=Summary(
                value=[Summary.Value(tag=name, simple_value=x) for name, x in values.items()]
            ),
        )

    def flush() -> None:
        for writer in writers.values():
            writer.flush()

    def rows(rows: list[Row]) -> None:
        for row in rows:
            scalars(row["seed"], row["steps"], numbers(row))
        flush()

    def evaluations(rows: list[Row]) -> None:
        for row in rows:
            scalars(row["seed"], row["steps"], scores(row))
        flush()

    def close(paths: list[Path], finished: bool) -> None:
        images = [
            Summary.Value(tag=path.name, image=_image(path))
            for path in paths
            if path.suffix == ".png"
        ]
        for seed, writer in writers.items():
            write(seed, summary=Summary(value=images))
            writer.close()

    for seed in writers:
        write(seed, step=place.kept + 1, session_log=SessionLog(status=SessionLog.START))
        write(seed, summary=text("configuration", _table(settings(place.config, seed))))
    flush()
    return MetricLogger(rows, evaluations, close)


def _writer(folder: Path):
    """Of an event file whose name no other has, also within a second."""
    from tensorboardX.event_file_writer import EventsWriter

    folder.mkdir(parents=True, exist_ok=True)
    return EventsWriter(str(folder / "events"), f".{len(list(folder.iterdir()))}")


def _image(path: Path):
    """A PNG as it is, with the size that its header says."""
    from tensorboardX.proto.summary_pb2 import Summary

    data = path.read_bytes()
    width, height = struct.unpack(">II", data[16:24])
    return Summary.Image(width=width, height=height, colorspace=4, encoded_image_string=data)


def _table(values: dict) -> str:
    return "\n".join(
        [
            "| setting | value |",
            "|---|---|",
            *(f"| {name} | {value} |" for name, value in values.items()),
        ]
    )


SECONDS = 3.0
"""How long to wait for the server before the run stays offline."""


def wandb_logger(place: Place) -> MetricLogger:
    """The run of each seed, begun or continued."""
    import wandb

    mode, last = _mode(), [place.kept]
    runs = {}
    for seed in seeds_of(place.config):
        name, known = name_of(place, seed), place.ids.setdefault(str(seed), secrets.token_hex(4))
        runs[seed] = wandb.init(
            dir=str(place.run_dir),
            project=os.environ.get("WANDB_PROJECT") or "dgae_jax",
            group=place.run_dir.resolve().name,
            name=name,
            id=known,
            resume=None if mode == "offline" else "allow",
            mode=mode,
            reinit="create_new",
            settings=wandb.Settings(silent=True, console="off"),
        )
        runs[seed].config.update(settings(place.config, seed), allow_val_change=True)
        runs[seed].define_metric("*", step_metric="steps")
        if mode == "online":
            terminal.say(f"{name} at {runs[seed].url}")

    def rows(rows: list[Row]) -> None:
        for row in rows:
            runs[row["seed"]].log({"steps": row["steps"], **numbers(row)}, step=2 * row["steps"])
            last[0] = row["steps"]

    def evaluations(rows: list[Row]) -> None:
        for row in rows:
            runs[row["seed"]].log({"steps": row["steps"], **scores(row)}, step=2 * row["steps"] + 1)

    def close(paths: list[Path], finished: bool) -> None:
        for run in runs.values():
            media = {
                path.name: (wandb.Image if path.suffix == ".png" else wandb.Video)(str(path))
                for path in paths
            }
            if media:
                run.log(media, step=2 * last[0] + 2)
            run.finish(exit_code=0 if finished else 1)

    return MetricLogger(rows, evaluations, close)


def _mode() -> Any:
    """What the user said; otherwise online if it can be, since nobody may be there to answer for a login."""
    import wandb

    chosen = wandb.setup().settings
    if os.environ.get("WANDB_MODE") or chosen.mode != "online":
        return chosen.mode
    return "online" if _has_login(chosen.base_url) and _answers(chosen.base_url) else "offline"


def _has_login(server: str) -> bool:
    """Whether there is a key in the environment or in ~/.netrc, where `wandb login` puts it."""
    from requests.utils import get_netrc_auth

    return (
        any(os.environ.get(name) for name in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE"))
        or get_netrc_auth(server) is not None
    )


def _answers(server: str) -> bool:
    """Whether anything listens there, or at the proxy on the way."""
    from requests.utils import get_environ_proxies, select_proxy

    address = urlsplit(select_proxy(server, get_environ_proxies(server)) or server)
    try:
        socket.create_connection(
            (address.hostname, address.port or {"http": 80}.get(address.scheme, 443)), SECONDS
        ).close()
    except OSError:
        return False
    return True


BATCH = 1000
"""Most metrics that MLflow takes in one request."""


def mlflow_logger(place: Place) -> MetricLogger:
    """The run of each seed, begun or continued."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
    from mlflow import MlflowClient
    from mlflow.entities import Metric

    client = MlflowClient(_address(place.run_dir))
    runs = {seed: _run(client, place, seed) for seed in seeds_of(place.config)}
    started = {seed: run.info.start_time for seed, run in runs.items()}

    def write(seed: int, metrics: list[Any]) -> None:
        for first in range(0, len(metrics), BATCH):
            client.log_batch(
                runs[seed].info.run_id, metrics=metrics[first : first + BATCH], synchronous=True
            )

    def rows(rows: list[Row]) -> None:
        for seed in runs:
            own = [row for row in rows if row["seed"] == seed]
            times = [started[seed] + round(1000 * row["seconds"]) for row in own]
            write(
                seed,
                [
                    Metric(k, x, at, row["steps"])
                    for row, at in zip(own, times, strict=True)
                    for k, x in numbers(row).items()
                ],
            )

    def evaluations(rows: list[Row]) -> None:
        now = round(1000 * time.time())
        for row in rows:
            write(
                row["seed"], [Metric(name, x, now, row["steps"]) for name, x in scores(row).items()]
            )

    def close(paths: list[Path], finished: bool) -> None:
        for run in runs.values():
            _keep(client, place.run_dir, run, paths)
            client.set_terminated(run.info.run_id, "FINISHED" if finished else "KILLED")

    return MetricLogger(rows, evaluations, close)


def _address(run_dir: Path) -> str:
    given = os.environ.get("MLFLOW_TRACKING_URI")
    if given:
        return given
    (run_dir / "mlflow").mkdir(exist_ok=True)
    return f"sqlite:///{(run_dir / 'mlflow' / 'mlflow.db').resolve()}"


def _experiment(client, run_dir: Path) -> str:
    """Of the name that MLFLOW_EXPERIMENT_NAME says; files lie in the run directory unless a server keeps them."""
    name = os.environ.get("MLFLOW_EXPERIMENT_NAME") or "dgae_jax"
    found = client.get_experiment_by_name(name)
    own = (
        None
        if os.environ.get("MLFLOW_TRACKING_URI")
        else (run_dir / "mlflow" / "files").resolve().as_uri()
    )
    return found.experiment_id if found else client.create_experiment(name, artifact_location=own)


def _run(client, place: Place, seed: int):
    """A new run with its settings, or the one that was begun before, whose settings MLflow lets nobody change."""
    from mlflow.entities import Param

    known = place.ids.get(str(seed))
    if known:
        client.update_run(known, status="RUNNING")
    else:
        run = client.create_run(_experiment(client, place.run_dir), run_name=name_of(place, seed))
        place.ids[str(seed)] = known = run.info.run_id
        client.log_batch(
            known,
            params=[
                Param(name, str(value)) for name, value in settings(place.config, seed).items()
            ],
        )
    run = client.get_run(known)
    _keep(client, place.run_dir, run, [place.run_dir / "config.json"])
    return run


def _keep(client, run_dir: Path, run, paths: list[Path]) -> None:
    """Files beside the metrics; not where the store lay before its directory was moved, the only place that it knows."""
    kept = urlsplit(run.info.artifact_uri)
    if kept.scheme == "file" and not Path(unquote(kept.path)).is_relative_to(run_dir.resolve()):
        return
    for path in paths:
        client.log_artifact(run.info.run_id, str(path))


class Kind(NamedTuple):
    """A sink that can be asked for."""

    begin: Callable[[Place], MetricLogger]
    goes_back: bool
    """Whether it can take back what followed the checkpoint; one that cannot keeps it, and does not get it again."""


KINDS = {
    "tensorboard": Kind(tensorboard_logger, goes_back=True),
    "wandb": Kind(wandb_logger, goes_back=False),
    "mlflow": Kind(mlflow_logger, goes_back=False),
}

ITERATIONS = 256
"""Most iterations that are read at once."""

PICTURES = ("curve.png", "video.mp4", "video.gif")
"""Files of the run directory that sinks get at the end."""


class Feed:
    """The open sinks of one run; `done` are the samples of each run in its files so far. No function of it raises or waits but `close`."""

    def __init__(self, names: tuple[str, ...], run_dir: Path, config: ResolvedConfig, done: int):
        self.run_dir, self.config = run_dir, config
        self.path = run_dir / "sinks.json"
        self.state = _read(self.path) if names else {}
        self.sinks: dict[str, MetricLogger] = {}
        self.thread, self.context = ThreadPoolExecutor(1, "sinks"), contextvars.copy_context()
        for name in names:
            self._later(self._try, name, self._open, done)

    def rows(self, rows: list[Row]) -> None:
        """Metrics of some iterations, all seeds of each."""
        self._each(self._give, "rows", rows)

    def evaluations(self, rows: list[Row]) -> None:
        """One evaluation of all seeds."""
        self._each(self._give, "evaluations", rows)

    def close(self, finished: bool) -> None:
        """Wait until all is written; `finished` if the run reached its end."""
        self._each(self._close, finished)
        self.thread.shutdown()

    def _each(self, work: Callable[..., None], *args) -> None:
        self._later(self._all, work, *args)

    def _later(self, work: Callable[..., None], *args) -> None:
        self.thread.submit(self.context.run, work, *args)  # it is as quiet there as here

    def _all(self, work: Callable[..., None], *args) -> None:
        for name in tuple(self.sinks):
            self._try(name, work, *args)

    def _try(self, name: str, work: Callable[..., None], *args) -> None:
        try:
            work(name, *args)
        except Exception as reason:  # a library, a network and a disk may raise anything, and none of it is worth the run
            self.sinks.pop(name, None)
            why = f"{type(reason).__name__}: {reason}".strip().partition("\n")[0][:300]
            terminal.warn(
                f"warning: --log {name} stops here ({why}); the training goes on, and --resume adds what is missing"
            )

    def _open(self, name: str, done: int) -> None:
        noted, kind = self.state.setdefault(name, _noted({})), KINDS[name]
        if kind.goes_back:
            kept = min(done, noted["rows"])
            noted |= {"rows": kept, "evaluations": min(kept, noted["evaluations"])}
        self.sinks[name] = kind.begin(Place(self.run_dir, self.config, noted["ids"], noted["rows"]))
        self._note()
        known = (
            row
            for row, _ in files.whole_rows(self.run_dir / "metrics.jsonl")
            if row["steps"] <= done
        )
        while chunk := list(itertools.islice(known, ITERATIONS * self.config.num_seeds)):
            self._give(name, "rows", chunk)
        evaluated = (
            row
            for row in EvaluationsFile(self.run_dir / "evaluations.jsonl").rows
            if row["steps"] <= done
        )
        self._give(name, "evaluations", list(evaluated))

    def _give(self, name: str, part: str, rows: list[Row]) -> None:
        """What of the rows the sink does not have yet."""
        noted = self.state[name]
        new = [row for row in rows if row["steps"] > noted[part]]
        if new:
            getattr(self.sinks[name], part)(new)
            noted[part] = new[-1]["steps"]
            self._note()

    def _close(self, name: str, finished: bool) -> None:
        present = [self.run_dir / picture for picture in PICTURES]
        self.sinks.pop(name).close([path for path in present if path.exists()], finished)

    def _note(self) -> None:
        files.write_json(self.path, self.state)


def _read(path: Path) -> dict[str, Any]:
    """How far each sink has come; a file that cannot be understood says nothing."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return {name: _noted(found.get(name)) for name in KINDS} if isinstance(found, dict) else {}


def _noted(found: Any) -> dict[str, Any]:
    found = found if isinstance(found, dict) else {}
    ids = found.get("ids")
    known = (
        {seed: each for seed, each in ids.items() if isinstance(each, str)}
        if isinstance(ids, dict)
        else {}
    )
    steps = {part: found.get(part) for part in ("rows", "evaluations")}
    return {
        "ids": known,
        **{part: at if type(at) is int and at >= 0 else 0 for part, at in steps.items()},
    }
