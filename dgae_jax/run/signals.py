"""Stopping on request."""

import contextlib
import os
import signal
from collections.abc import Iterator
from typing import Any


class Stopped(Exception):
    """A signal arrived where nothing is lost by stopping at once."""


class Signals:
    """Notes the first SIGINT or SIGTERM, so that the running dispatch can finish; a second one ends the process at once."""

    def __init__(self):
        self.received: signal.Signals | None = None
        self.before: dict[signal.Signals, Any] = {}
        self.nothing_to_lose = False

    def __enter__(self) -> "Signals":
        self.before = {kind: signal.signal(kind, self._note) for kind in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_) -> None:
        for kind, handler in self.before.items():
            signal.signal(kind, handler)

    @contextlib.contextmanager
    def may_stop(self) -> Iterator[None]:
        """Around work that may be broken off: raises `Stopped` when a signal arrives, or has arrived."""
        self.nothing_to_lose = True
        try:
            self._stop()
            yield
        finally:
            self.nothing_to_lose = False

    @property
    def name(self) -> str:
        """Of the signal that came, SIGINT or SIGTERM."""
        return self.received.name if self.received else ""

    @property
    def exit_code(self) -> int:
        """130 after SIGINT, 143 after SIGTERM."""
        return 128 + (self.received or 0)

    def _stop(self) -> None:
        if self.received and self.nothing_to_lose:
            raise Stopped

    def _note(self, kind: int, _) -> None:
        self.received = signal.Signals(kind)
        for each in self.before:
            signal.signal(each, signal.SIG_DFL)
        self._stop()
        # no print: it may be what was interrupted
        os.write(2, f"{self.name}: finishing what is running, then saving; a second signal ends it at once\n".encode())
