"""Printing, which never ends a run: a reader that is gone, a full disk or an old terminal costs a line, not the training.

Everything a run says goes through here. It imports nothing of the package, so that a command can call `prepare` first.
"""

import contextlib
import io
import os
import shutil
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any, TextIO

_DUMB = (None, "", "dumb", "unknown")

_silent: ContextVar[bool] = ContextVar("silent", default=False)


def prepare() -> None:
    """Make the standard streams of this process harmless; the first thing that a command does.

    Streams that were closed (`>&-`) are opened on nothing, so that no file of the run takes their place and receives what
    libraries print. Characters that the terminal's encoding lacks are written as escapes.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(
                os.open(os.devnull, os.O_RDWR), True
            )  # it takes the lowest number that is free: this one
    for name in ("stdout", "stderr"):
        stream: Any = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: PTH123, SIM115
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def say(text: str) -> None:
    """A line on stdout."""
    if not _silent.get():
        write(sys.stdout, text + "\n")


def warn(text: str) -> None:
    """A line on stderr."""
    write(sys.stderr, text + "\n")


@contextlib.contextmanager
def silenced(quiet: bool = True) -> Iterator[None]:
    """Nothing is said meanwhile; warnings are."""
    token = _silent.set(quiet or _silent.get())
    try:
        yield
    finally:
        _silent.reset(token)


def is_silent() -> bool:
    """Whether nothing is to be said."""
    return _silent.get()


def is_live() -> bool:
    """Whether stdout is a terminal that someone may be looking at, and on which a line can be written again."""
    try:
        return (
            sys.stdout is not None
            and sys.stdout.isatty()
            and os.environ.get("TERM") not in _DUMB
            and not _silent.get()
        )
    except ValueError:  # closed
        return False


def width() -> int:
    """Columns that a line may have."""
    return shutil.get_terminal_size().columns


def write(stream: TextIO | None, text: str) -> None:
    """Write and flush, or give the stream up for good."""
    if stream is None:
        return
    try:
        try:
            stream.write(text)
        except UnicodeEncodeError:
            encoding = stream.encoding or "ascii"
            stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        stream.flush()
    except (OSError, ValueError):  # a reader that is gone, a full disk; a closed stream
        _give_up(stream)


def _give_up(stream: TextIO) -> None:
    """Let the stream end in nothing: Python flushes what is left in it once more when the process ends."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, stream.fileno())
        os.close(nothing)


class Steady(io.StringIO):
    """stdout for a library that prints on its own: no write to it fails."""

    def __init__(self, stream: TextIO):
        super().__init__()
        self.stream = stream

    def write(self, text: str) -> int:
        """All of it, or nothing."""
        write(self.stream, text)
        return len(text)

    def isatty(self) -> bool:
        """As the stream beneath."""
        return self.stream.isatty()

    def fileno(self) -> int:
        """Of the stream beneath."""
        return self.stream.fileno()

    @property
    def encoding(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Of the stream beneath."""
        return self.stream.encoding
