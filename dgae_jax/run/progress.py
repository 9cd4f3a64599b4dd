"""How a run is going: a live bar on a terminal, a picture in a notebook, plain lines when piped."""

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from dgae_jax.run import terminal
from dgae_jax.run.notebook import Page

PLAIN_EVERY = 10.0
"""Seconds between plain lines."""


class Reporter:
    """Shows samples, samples per second over all seeds, the mean return, and the time left; or whatever else takes time."""

    def __init__(self, total: int = 0, runs: int = 1, page: Page | None = None):
        """`page` takes the place of the lines."""
        self.total, self.runs, self.page = total, runs, page
        self.printed = time.monotonic()
        self.bar = None
        if terminal.is_live():
            console = Console(file=terminal.Steady(sys.stdout))
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
            terminal.say(text)

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
