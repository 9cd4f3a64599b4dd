"""Feeds the sinks of a run from the rows of its own files, beside the training; a sink that fails costs one warning.

`sinks.json` in the run directory says how far each of them has come. Whatever a sink lacks of the rows up to the checkpoint that
a run is resumed from, because it failed, was asked for later only or was killed, it gets then; whatever it has already, it does
not get twice.
"""

import contextvars
import itertools
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import files, terminal
from dgae_jax.run.evaluations import EvaluationsFile
from dgae_jax.run.sinks import mlflow, tensorboard, wandb
from dgae_jax.run.sinks.sink import Place, Row, Sink


class Kind(NamedTuple):
    """A sink that can be asked for."""

    begin: Callable[[Place], Sink]
    goes_back: bool
    """Whether it can take back what followed the checkpoint; one that cannot keeps it, and does not get it again."""


KINDS = {
    "tensorboard": Kind(tensorboard.begin, goes_back=True),
    "wandb": Kind(wandb.begin, goes_back=False),
    "mlflow": Kind(mlflow.begin, goes_back=False),
}

ITERATIONS = 256
"""Most iterations that are read at once."""

PICTURES = ("curve.png", "film.mp4", "film.gif")
"""Files of the run directory that sinks get at the end."""


class Feed:
    """The open sinks of one run; `done` are the samples of each run in its files so far. No function of it raises or waits but `close`."""

    def __init__(self, names: tuple[str, ...], run_dir: Path, config: ResolvedConfig, done: int):
        self.run_dir, self.config = run_dir, config
        self.path = run_dir / "sinks.json"
        self.state = _read(self.path) if names else {}
        self.sinks: dict[str, Sink] = {}
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
