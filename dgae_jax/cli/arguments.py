"""Command lines: flags from dataclasses, and one clear line for a user's mistake."""

import argparse
import contextlib
import io
import re
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn, TypeVar

import tyro

from dgae_jax.configs.config import ConfigError, flag
from dgae_jax.run import terminal

T = TypeVar("T")

_FRAME = re.compile(r"[╭╮╰╯├┤│─+|\- ]*")  # tyro draws it in ASCII where the terminal has no more


def fail(mistake: Exception | str) -> NoReturn:
    """One line on stderr, exit code 2; a setting of the library is written as its flag."""
    message, setting = str(mistake), getattr(mistake, "setting", None)
    if setting and message.startswith(setting):
        message = flag(setting) + message[len(setting) :]
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in message)  # one line, whatever was typed
    terminal.warn(f"error: {shown}")
    raise SystemExit(2)


def peek(argv: Sequence[str], *names: str) -> dict[str, str | None]:
    """The values of some settings, looked at before the rest is parsed; None where there is none."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in names:
        parser.add_argument(flag(name), dest=name, nargs="?")
    return vars(parser.parse_known_args(argv)[0])


def parse(cls: type[T], description: str, argv: Sequence[str] | None = None, default: T | None = None) -> T:
    """The dataclass `cls` filled from the command line, over `default`; `--help` explains every field."""
    over: dict[str, Any] = {} if default is None else {"default": default}
    with _mistakes_in_one_line():
        return tyro.cli(cls, description=description, args=argv, **over)


def parse_known(cls: type[T], description: str, argv: Sequence[str]) -> tuple[T, list[str]]:
    """`parse` for a command line that says more: the dataclass, and the words that are not its own."""
    with _mistakes_in_one_line():
        return tyro.cli(cls, description=description, args=argv, return_unknown_args=True)


@contextlib.contextmanager
def _mistakes_in_one_line() -> Iterator[None]:
    screen = io.StringIO()
    try:
        with contextlib.redirect_stderr(screen):
            yield
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        fail(ConfigError(_one_line(screen.getvalue())))


def _one_line(box: str) -> str:
    """The sentence inside tyro's framed message, without title, frame and pointer to the help text."""
    lines = [line.strip().strip("│|").strip() for line in box.splitlines()[1:] if not _FRAME.fullmatch(line.strip())]
    body = " ".join(line for line in lines if line).partition("For full helptext")[0]
    return re.sub(r"\s+", " ", body).strip() + " (--help lists every flag)"
