"""Policy gradients with value distributions, end to end in JAX.

dgae COMMAND --help lists the flags of a command.
dgae --version prints the versions that results depend on.
dgae --completion bash|zsh|fish prints a script for the shell.

exit codes: 0 done; 1 diverged or could not write; 2 bad input;
            129, 130 or 143 stopped by SIGHUP, SIGINT or SIGTERM
"""

import inspect
import platform
import sys
from importlib import import_module, metadata
from typing import Annotated, Any, Union

import tyro

import dgae_jax
from dgae_jax.cli import parse
from dgae_jax.run import terminal

COMMANDS = (
    *("train", "evaluate", "calibrate", "refit", "reproduce"),
    *("report", "tune", "render", "export", "figures"),
)

MODULES = {"calibrate": "evaluate", "refit": "evaluate", "render": "export", "figures": "export"}
"""Modules of commands that are not named like them."""

LIBRARIES = ("jax", "mujoco", "mujoco-mjx", "brax", "gymnasium")
"""What results depend on most."""


def command(name: str) -> parse.Command:
    """Return the command of that name."""
    return getattr(import_module(f"dgae_jax.cli.{MODULES.get(name, name)}"), name)


def main() -> int:
    """Run one command."""
    terminal.prepare()
    words = sys.argv[1:] or ["--help"]
    name, _, shell = words[0].partition("=")
    if words[0] in COMMANDS:
        sys.argv = [f"dgae {name}", *words[1:]]
        return command(name)()
    if words[0] == "--version":
        versions = ", ".join(f"{library} {metadata.version(library)}" for library in LIBRARIES)
        ours = f"dgae_jax {dgae_jax.__version__}\nPython {platform.python_version()}"
        terminal.say(f"{ours}, {versions}")
        return 0
    if name == "--completion":
        words = ["--tyro-print-completion", shell or "".join(words[1:2])]
    parse.arguments(_any_command(), words, description=__doc__, prog="dgae")
    return 0


def _any_command() -> Any:
    """Return the type of which tyro makes the help, the completion and the message of a mistake."""
    kinds = []
    for name in COMMANDS:
        flags = command(name).arguments
        purpose = (inspect.getdoc(flags) or "").partition("\n")[0]
        kinds.append(Annotated[flags, tyro.conf.subcommand(name, description=purpose)])
    return Union[tuple(kinds)]  # noqa: UP007
