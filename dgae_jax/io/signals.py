"""Stopping on request."""

import signal
from typing import Any


class Signals:
    """Notes the first SIGINT or SIGTERM, so that the running dispatch can finish; a second one acts at once."""

    def __init__(self):
        self.received: signal.Signals | None = None
        self.before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "Signals":
        self.before = {kind: signal.signal(kind, self._note) for kind in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_) -> None:
        for kind, handler in self.before.items():
            signal.signal(kind, handler)

    def _note(self, kind: int, _) -> None:
        self.received = signal.Signals(kind)
        for each in self.before:
            signal.signal(each, signal.SIG_DFL)
