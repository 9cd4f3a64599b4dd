"""MLflow: a SQLite store in RUN_DIR/mlflow, or the server that MLFLOW_TRACKING_URI names; one run per seed.

It is a database because MLflow refuses to write its older store of plain files. Times of metrics are those of the run, so that a
row that is given twice is one.
"""

import os
import time
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from dgae_jax.run.sinks.sink import Place, Row, Sink, name_of, numbers, scores, seeds_of, settings

BATCH = 1000
"""Most metrics that MLflow takes in one request."""


def begin(place: Place) -> Sink:
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

    return Sink(rows, evaluations, close)


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
