"""Command lines: flags from dataclasses, and one clear line for a user's mistake."""

import argparse
import contextlib
import io
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from typing import NoReturn, TypeVar

import tyro

from dgae_jax.cli import mistakes
from dgae_jax.cli.flags import Leaf, built, leaves, view
from dgae_jax.cli.spelling import refuse_foreign
from dgae_jax.configs.config import ConfigError, flag
from dgae_jax.run import terminal

T = TypeVar("T")


def fail(mistake: Exception | str) -> NoReturn:
    """One line on stderr, exit code 2; a setting of the library is written as its flag."""
    message, setting = str(mistake), getattr(mistake, "setting", None)
    if setting and message.startswith(setting):
        message = flag(setting) + message[len(setting) :]
    shown = "".join(
        c if c.isprintable() else ascii(c)[1:-1] for c in message
    )  # one line, whatever was typed
    terminal.warn(f"error: {shown}")
    raise SystemExit(2)


def stopped(why: str) -> int:
    """Say why a command ends after SIGINT; 130. The process ends here where a compiler was left to itself, which would abort it."""
    terminal.warn(why)
    runtime = sys.modules.get("dgae_jax.run.runtime")  # imported by now if JAX compiles
    if runtime and runtime.is_compiling():
        os._exit(130)
    return 130


def flags_in(words: Sequence[str]) -> set[str]:
    """The flags among the words of a command line, without their values."""
    return {mistakes.flag_of(word) for word in words if word.startswith("--")}


def peek(argv: Sequence[str], *names: str) -> dict[str, str | None]:
    """The values of some settings, looked at before the rest is parsed; None where there is none."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in names:
        parser.add_argument(flag(name), dest=name, nargs="?")
    return vars(parser.parse_known_args(argv)[0])


def parse(
    cls: type[T],
    purpose: str,
    argv: Sequence[str] | None = None,
    default: T | None = None,
    examples: Sequence[str] = (),
    note: str = "",
) -> T:
    """The dataclass `cls` filled from the command line, over `default`.

    `--help` says what the command is for, explains every field, and ends with the note and the examples.
    """
    argv, listed = sys.argv[1:] if argv is None else argv, list(leaves(cls, default))
    _refuse_unknown(argv, listed)
    with _understandable(listed, argv, examples, note):
        return built(cls, tyro.cli(view(listed), description=purpose, args=argv))


def parse_known(
    cls: type[T],
    purpose: str,
    argv: Sequence[str],
    examples: Sequence[str] = (),
    note: str = "",
    rest: Sequence[type] = (),
) -> tuple[T, list[str]]:
    """`parse` for a command line that says more: the dataclass, and the words that are of the dataclasses `rest`."""
    ours = list(leaves(cls))
    _refuse_unknown(
        argv, [*ours, *(leaf for other in rest for leaf in leaves(other))], refuse_foreign
    )
    with _understandable(ours, argv, examples, note):
        parsed, words = tyro.cli(
            view(ours), description=purpose, args=argv, return_unknown_args=True
        )
    return built(cls, parsed), words


def _refuse_unknown(
    argv: Sequence[str], listed: Sequence[Leaf], foreign: Callable[[str], None] = lambda _: None
) -> None:
    """Raise ConfigError for a flag that there is not; tyro's flags for completion know one command only, and may end in a stack trace."""
    word = mistakes.unknown(argv, listed)
    if word is None or {"-h", "--help"}.intersection(argv):
        return
    foreign(word)
    raise ConfigError(
        f"{word}: is written dgae --completion SHELL"
        if word.startswith("--tyro")
        else mistakes.not_a_flag(word, listed)
    )


@contextlib.contextmanager
def _understandable(
    listed: Sequence[Leaf], argv: Sequence[str], examples: Sequence[str], note: str
) -> Iterator[None]:
    """The help with an ending, and a mistake in one line."""
    tyro._experimental_options["ansi_codes"] = not os.environ.get("NO_COLOR")
    screen = io.StringIO()
    try:
        with contextlib.redirect_stderr(screen):
            yield
    except SystemExit as stop:
        if stop.code in (0, None):  # the help was printed
            terminal.say("\n".join(_ending(examples, note)))
            raise
        fail(ConfigError(mistakes.sentence(screen.getvalue(), listed, argv)))


def _ending(examples: Sequence[str], note: str) -> Iterator[str]:
    if note:
        yield "\n" + textwrap.fill(re.sub(r"\s+", " ", note), terminal.width())
    if examples:
        yield "\n".join(["", "examples:", *(f"  {line}" for line in examples)])
