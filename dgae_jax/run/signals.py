"""Stopping on request."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from typing import Any

from dgae_jax.run import hosts
from dgae_jax.run.compiling import Watch, unwatched

KINDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, a scheduler, and a terminal that was closed."""


class Stopped(Exception):
    """A signal arrived where nothing is lost by stopping at once."""


class Signals:
    """Notes the first signal, so that the running dispatch can finish; a second one ends the process at once.

    A second SIGHUP does not: a terminal that closes may send several, and systemd sends one after SIGTERM. SIGHUP stays
    ignored where it was (`nohup`). Outside of the main thread Python has no signals, and none are noted.
    """

    def __init__(self):
        self.received: signal.Signals | None = None
        self.agreed = False
        self.before: dict[signal.Signals, Any] = {}
        self.nothing_to_lose = False

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            noted = [
                kind
                for kind in KINDS
                if kind != signal.SIGHUP or signal.getsignal(kind) != signal.SIG_IGN
            ]
            self.before = {kind: signal.signal(kind, self._note) for kind in noted}
        return self

    def __exit__(self, *_) -> None:
        for kind, handler in self.before.items():
            signal.signal(kind, handler)

    @contextlib.contextmanager
    def may_stop(self, watch: Watch = unwatched) -> Iterator[Watch]:
        """Around work that may be broken off: raises `Stopped` if a signal has arrived, as does the watch that it gives, later.

        The handler itself raises nothing: it may interrupt an import or a destructor of anybody's, which would lose the exception or
        keep a lock. Of several processes none can be broken off alone: there only what all have agreed on counts.
        """

        def heeding(text: str) -> None:
            self._stop()
            watch(text)

        self.nothing_to_lose = hosts.alone() or self.agreed
        try:
            self._stop()
            yield heeding
        finally:
            self.nothing_to_lose = False

    def anywhere(self) -> bool:
        """Whether a signal has come to any process of the run; every process must ask."""
        kind = hosts.most(self.received or 0)
        if kind:
            self.received, self.agreed = signal.Signals(kind), True
        return self.agreed

    @property
    def name(self) -> str:
        """Of the signal that came: SIGINT, SIGTERM or SIGHUP."""
        return self.received.name if self.received else ""

    @property
    def exit_code(self) -> int:
        """130 after SIGINT, 143 after SIGTERM, 129 after SIGHUP."""
        return 128 + (self.received or 0)

    def _stop(self) -> None:
        if self.received and self.nothing_to_lose:
            raise Stopped

    def _note(self, kind: int, _) -> None:
        self.received = signal.Signals(kind)
        for each in self.before:
            signal.signal(each, signal.SIG_IGN if each == signal.SIGHUP else signal.SIG_DFL)
        if self.nothing_to_lose:
            return
        with contextlib.suppress(OSError):  # no print: it may be what was interrupted
            os.write(
                2,
                f"{self.name}: finishing what is running, then saving; a second signal ends it at once\n".encode(),
            )
