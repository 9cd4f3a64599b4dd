"""Printing, which never ends a run: a reader that is gone, a full disk or an old terminal costs a line, not the training.

Everything a run says goes through here. It imports nothing of the package, so that a command can call `prepare` first.
"""

import base64
import contextlib
import gc
import io
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


EVERY = 4.0
"""Least seconds between two pictures; drawing never takes more than a tenth of the time either."""

WIDTH = 640
"""Of the picture on the screen [CSS pixels]; it has more pixels than that, for fine screens."""


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook, and someone wants to see anything. IPython is not imported for it."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return getattr(shell, "kernel", None) is not None and not is_silent()


class Page:
    """Words until there is something to draw, then the picture with the words in it."""

    def __init__(self, draw: "Callable[[], Figure | None]"):
        """`draw` makes the picture as it is now, None while there is nothing to see."""
        self.draw, self.shown, self.due = draw, None, 0.0

    def show(self, words: str, at_once: bool = False) -> None:
        """Replace what is shown, unless it was a moment ago."""
        began = time.monotonic()
        if began < self.due and not at_once:
            return
        figure = self.draw()
        self._put({"text/plain": words}, {}) if figure is None else self._put(
            *_picture(figure, words)
        )
        ended = time.monotonic()
        self.due = ended + max(EVERY, 9 * (ended - began))

    def _put(self, data: dict[str, Any], metadata: dict[str, Any]) -> None:
        from IPython.display import display

        if self.shown is None:
            self.shown = display(data, raw=True, metadata=metadata, display_id=True)
        else:
            self.shown.update(data, raw=True, metadata=metadata)


def _picture(figure: "Figure", words: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """A PNG and how wide it is shown."""
    axes = figure.axes[0]
    title = axes.get_title()
    if words:
        axes.set_title(f"{title}\n{words}", fontsize=9)
    image = io.BytesIO()
    figure.savefig(image, format="png")
    gc.collect()  # see record._plot
    png = base64.b64encode(image.getvalue()).decode()
    return {"image/png": png, "text/plain": f"{title} {words}".strip()}, {
        "image/png": {"width": WIDTH}
    }


PLAIN_EVERY = 10.0
"""Seconds between plain lines."""


class Reporter:
    """Shows samples, samples per second over all seeds, the mean return, and the time left; or whatever else takes time."""

    def __init__(self, total: int = 0, runs: int = 1, page: Page | None = None):
        """`page` takes the place of the lines."""
        self.total, self.runs, self.page = total, runs, page
        self.printed = time.monotonic()
        self.bar = None
        if is_live():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            console = Console(file=Steady(sys.stdout))
            self.bar = Progress(
                BarColumn(None),
                TextColumn("{task.description}"),
                console=console,
                transient=not total,
            )
            self.task = self.bar.add_task("", total=total or None)

    def __enter__(self) -> "Reporter":
        if self.bar:
            self.bar.start()
        return self

    def announce(self, text: str) -> None:
        """A line that is printed whatever was printed last; on a terminal the bar says it."""
        if self.page:
            self.page.show(text, at_once=True)
        elif not self.bar:
            self.printed = time.monotonic()
            say(text)

    def watch(self, text: str) -> None:
        """What is going on: the bar's text, or a line every ten seconds."""
        if self.page:
            self.page.show(text)
        elif self.bar:
            self.bar.update(self.task, description=text)
        elif time.monotonic() - self.printed >= PLAIN_EVERY:
            self.announce(text)

    def update(self, steps: int, speed: float, mean_return: float | None) -> None:
        """`speed` in samples of one run per second; returns may not exist yet."""
        left = (self.total - steps) / speed
        shown = "–" if mean_return is None else f"{mean_return:,.1f}"
        done = (
            f"{steps:,}/{self.total:,}" if self.bar else f"{steps:,} of {self.total:,} steps"
        )  # 2,147,483,647 fit 80 columns
        text = f"{done}  {speed * self.runs:,.0f} steps/s  return {shown}  {clock(left)} left"
        if self.bar:
            self.bar.update(self.task, completed=steps)
        (self.announce if steps >= self.total and not self.bar else self.watch)(text)

    def __exit__(self, kind: type[BaseException] | None, *_) -> None:
        if self.bar:
            self.bar.stop()
        if self.page and kind is None:
            self.page.show("", at_once=True)


def clock(seconds: float) -> str:
    """Hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def counted(number: int, noun: str) -> str:
    """A number of things, with the plural unless it is one."""
    return f"{number} {noun}" + "s" * (number != 1)
