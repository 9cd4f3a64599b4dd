"""Output of a run: lines, a progress bar, a page in a notebook.

A failed write costs a line, never the run. This module imports nothing of the package.
"""

import contextlib
import datetime
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

LINE_SECONDS = 10.0
"""Time between progress lines where there is no terminal."""

PICTURE_SECONDS = 4.0
"""Least time between two pictures in a notebook."""

_silent: ContextVar[bool] = ContextVar("silent", default=False)


def prepare() -> None:
    """Make the standard streams harmless; the first thing that a command does.

    Closed streams (`>&-`) are opened on /dev/null, so that no file of the run takes their place.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # the lowest free number is that of this stream
            nothing = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(nothing, True)
            setattr(sys, name, open(nothing, mode))  # noqa: PTH123, SIM115


def say(text: str) -> None:
    """Print a line, unless silenced."""
    if not _silent.get():
        write(sys.stdout, text + "\n")


def warn(text: str) -> None:
    """Print a line on stderr."""
    write(sys.stderr, text + "\n")


@contextlib.contextmanager
def silenced(quiet: bool = True) -> Iterator[None]:
    """Print nothing but warnings within the context."""
    token = _silent.set(quiet or _silent.get())
    try:
        yield
    finally:
        _silent.reset(token)


def is_live() -> bool:
    """Return whether stdout is a terminal on which a line can be rewritten."""
    if sys.stdout is None or sys.stdout.closed or _silent.get():
        return False
    return sys.stdout.isatty() and os.environ.get("TERM", "") not in ("", "dumb", "unknown")


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook and not silenced."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return getattr(shell, "kernel", None) is not None and not _silent.get()


def write(stream: Any, text: str) -> None:
    """Write and flush, or give the stream up for good."""
    try:
        print(text, end="", file=stream, flush=True)
    except UnicodeEncodeError:
        write(stream, text.encode("ascii", "backslashreplace").decode())
    except (OSError, ValueError):  # no reader, a full disk, a closed stream
        with contextlib.suppress(OSError, ValueError, AttributeError):
            # Python flushes the rest once more at exit
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, stream.fileno())
            os.close(nothing)


class Steady:
    """A stream for libraries that print: no write to it fails."""

    def __init__(self, stream: Any):
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        """Write to the stream beneath, or lose the text."""
        write(self.stream, text)
        return len(text)


class Page:
    """One output in a notebook, replaced while the run continues: text, later the curve."""

    def __init__(self, draw: Callable[[str], bytes | None]):
        """Keep `draw`, which returns a PNG with a text; None before there is anything to draw."""
        from IPython.display import Pretty, display

        self.draw, self.due = draw, 0.0
        self.shown: Any = display(Pretty(""), display_id=True)

    def show(self, text: str, at_once: bool = False) -> None:
        """Replace what is shown, unless it was replaced a moment ago."""
        from IPython.display import Image, Pretty

        if time.monotonic() < self.due and not at_once:
            return
        png = self.draw(text)
        self.shown.update(Pretty(text) if png is None else Image(png, width=640))
        self.due = time.monotonic() + PICTURE_SECONDS


class Reporter:
    """Progress: a live bar on a terminal, a page in a notebook, lines elsewhere."""

    def __init__(self, total: int = 0, runs: int = 1, page: Page | None = None):
        """Report on `total` samples of each of `runs` seeds; `page` takes the place of lines."""
        self.total, self.runs, self.page = total, runs, page
        self.due = time.monotonic() + LINE_SECONDS
        self.bar = None
        if is_live():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = BarColumn(None), TextColumn("{task.description}")
            stdout: Any = Steady(sys.stdout)
            self.bar = Progress(*columns, console=Console(file=stdout), transient=not total)
            self.task = self.bar.add_task("", total=total or None)

    def __enter__(self) -> "Reporter":
        if self.bar:
            self.bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_) -> None:
        if self.bar:
            self.bar.stop()
        if self.page and kind is None:
            self.page.show("", at_once=True)

    def watch(self, text: str, at_once: bool = False) -> None:
        """Show what is going on: in the bar or page, or a line every ten seconds."""
        if self.page:
            self.page.show(text)
        elif self.bar:
            self.bar.update(self.task, description=text)
        elif at_once or time.monotonic() >= self.due:
            self.due = time.monotonic() + LINE_SECONDS
            say(text)

    def update(self, steps: int, speed: float, mean_return: float | None) -> None:
        """Show samples done, samples per second of one run, mean return and time left."""
        done, left = f"{steps:,} of {self.total:,} steps", clock((self.total - steps) / speed)
        shown = "–" if mean_return is None else f"{mean_return:,.1f}"
        text = f"{done}  {speed * self.runs:,.0f} steps/s  return {shown}  {left} left"
        if self.bar:
            self.bar.update(self.task, completed=steps)
        self.watch(text, at_once=steps >= self.total)


def clock(seconds: float) -> str:
    """Return days, hours, minutes and seconds as text."""
    return str(datetime.timedelta(seconds=round(seconds)))


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one."""
    return f"{number} {noun}" + "s" * (number != 1)
