"""How a run is going: a live bar on a terminal, plain lines when piped."""

import sys
import time

from rich.progress import BarColumn, Progress, TextColumn

PLAIN_EVERY = 10.0
"""Seconds between plain lines."""


class Reporter:
    """Shows samples, samples per second over all seeds, the mean return, and the time left."""

    def __init__(self, total: int, runs: int):
        self.total, self.runs = total, runs
        self.began = self.printed = time.monotonic()
        self.bar = Progress(BarColumn(None), TextColumn("{task.description}")) if sys.stdout.isatty() else None
        if self.bar:
            self.bar.start()
            self.task = self.bar.add_task("compiling", total=total)
        else:
            print("compiling", flush=True)

    def __enter__(self) -> "Reporter":
        return self

    def update(self, steps: int, speed: float, mean_return: float | None) -> None:
        """`speed` in samples of one run per second; returns may not exist yet."""
        left = (self.total - steps) / speed
        shown = "–" if mean_return is None else f"{mean_return:,.1f}"
        text = f"{steps:,} of {self.total:,} steps  {speed * self.runs:,.0f} steps/s  return {shown}  {_clock(left)} left"
        if self.bar:
            self.bar.update(self.task, completed=steps, description=text)
        elif steps >= self.total or time.monotonic() - self.printed >= PLAIN_EVERY:
            self.printed = time.monotonic()
            print(text, flush=True)

    def __exit__(self, *_) -> None:
        if self.bar:
            self.bar.stop()


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
