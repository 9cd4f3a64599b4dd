"""Output of a run: lines, a progress bar, a page in a notebook.

A failed write costs a line, never the run. This module imports nothing of the package.
"""

import base64
import contextlib
import gc
import io
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINE_SECONDS = 10.0
"""Time between progress lines where there is no terminal."""

PICTURE_SECONDS = 4.0
"""Least time between two pictures in a notebook; drawing takes at most a tenth of the time."""

PICTURE_WIDTH = 640
"""Width of a picture in a notebook [CSS pixels]."""

_silent: ContextVar[bool] = ContextVar("silent", default=False)


def prepare() -> None:
    """Make the standard streams harmless; the first thing that a command does.

    Closed streams (`>&-`) are opened on /dev/null, so that no file of the run takes their place.
    Characters that the encoding lacks are escaped.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:  # the lowest free number is this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    for name in ("stdout", "stderr"):
        stream: Any = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: PTH123, SIM115
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


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
    try:
        dumb = os.environ.get("TERM") in (None, "", "dumb", "unknown")
        return sys.stdout is not None and sys.stdout.isatty() and not dumb and not _silent.get()
    except ValueError:  # closed
        return False


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook and not silenced."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return getattr(shell, "kernel", None) is not None and not _silent.get()


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
    except (OSError, ValueError):  # no reader, a full disk, a closed stream
        with contextlib.suppress(OSError, ValueError, AttributeError):
            # Python flushes the rest once more at exit
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, stream.fileno())
            os.close(nothing)


class Steady(io.StringIO):
    """A stdout for libraries that print: no write to it fails."""

    def __init__(self, stream: TextIO):
        super().__init__()
        self.stream = stream
        self.isatty, self.fileno = stream.isatty, stream.fileno

    def write(self, text: str) -> int:
        """Write to the stream beneath, or lose the text."""
        write(self.stream, text)
        return len(text)

    @property
    def encoding(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Encoding of the stream beneath."""
        return self.stream.encoding


class Page:
    """One output of a notebook cell, replaced as the run goes on: text, later the curve."""

    def __init__(self, draw: "Callable[[], Figure | None]"):
        """Keep `draw`, which returns the figure as it is now, None before the first return."""
        self.draw, self.shown, self.due = draw, None, 0.0

    def show(self, text: str, at_once: bool = False) -> None:
        """Replace what is shown, unless it was replaced a moment ago."""
        from IPython.display import display

        began = time.monotonic()
        if began < self.due and not at_once:
            return
        figure = self.draw()
        data, metadata = ({"text/plain": text}, {}) if figure is None else _picture(figure, text)
        if self.shown is None:
            self.shown = display(data, raw=True, metadata=metadata, display_id=True)
        else:
            self.shown.update(data, raw=True, metadata=metadata)
        ended = time.monotonic()
        self.due = ended + max(PICTURE_SECONDS, 9 * (ended - began))


def _picture(figure: "Figure", text: str) -> tuple[dict[str, Any], dict[str, Any]]:
    axes = figure.axes[0]
    title = axes.get_title()
    if text:
        axes.set_title(f"{title}\n{text}", fontsize=9)
    image = io.BytesIO()
    figure.savefig(image, format="png")
    gc.collect()  # a figure is full of cycles: 3 MB each
    png = base64.b64encode(image.getvalue()).decode()
    data = {"image/png": png, "text/plain": f"{title} {text}".strip()}
    return data, {"image/png": {"width": PICTURE_WIDTH}}


class Reporter:
    """Progress: a live bar on a terminal, a page in a notebook, lines elsewhere."""

    def __init__(self, total: int = 0, runs: int = 1, page: Page | None = None):
        """Report on `total` samples of each of `runs` seeds; `page` takes the place of lines."""
        self.total, self.runs, self.page = total, runs, page
        self.printed = time.monotonic()
        self.bar = None
        if is_live():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = BarColumn(None), TextColumn("{task.description}")
            console = Console(file=Steady(sys.stdout))
            self.bar = Progress(*columns, console=console, transient=not total)
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

    def announce(self, text: str) -> None:
        """Show a line at once; the bar has it already."""
        if self.page:
            self.page.show(text, at_once=True)
        elif not self.bar:
            self.printed = time.monotonic()
            say(text)

    def watch(self, text: str) -> None:
        """Show what is going on: in the bar, or a line every ten seconds."""
        if self.page:
            self.page.show(text)
        elif self.bar:
            self.bar.update(self.task, description=text)
        elif time.monotonic() - self.printed >= LINE_SECONDS:
            self.announce(text)

    def update(self, steps: int, speed: float, mean_return: float | None) -> None:
        """Show samples done, samples per second of one run, mean return and time left."""
        left = (self.total - steps) / speed
        shown = "–" if mean_return is None else f"{mean_return:,.1f}"
        done = f"{steps:,}/{self.total:,}" if self.bar else f"{steps:,} of {self.total:,} steps"
        text = f"{done}  {speed * self.runs:,.0f} steps/s  return {shown}  {clock(left)} left"
        if self.bar:
            self.bar.update(self.task, completed=steps)
        (self.announce if steps >= self.total and not self.bar else self.watch)(text)


def clock(seconds: float) -> str:
    """Return hours, minutes and seconds as text."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one."""
    return f"{number} {noun}" + "s" * (number != 1)
