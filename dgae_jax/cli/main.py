"""The program `dgae`: its commands by name, help, versions and completion."""

import inspect
import platform
import sys
from collections.abc import Callable
from importlib import import_module, metadata
from typing import Annotated, Any, Union

import tyro

import dgae_jax
from dgae_jax.cli import parse
from dgae_jax.configs.config import invalid
from dgae_jax.run import terminal

COMMANDS = {
    "train": "train",
    "evaluate": "evaluate",
    "calibrate": "evaluate",
    "refit": "evaluate",
    "reproduce": "reproduce",
    "report": "report",
    "tune": "tune",
    "render": "render",
    "export": "export",
    "figures": "render",
}
"""Each command is a function of its name in a module of this room."""

DESCRIPTION = """Policy gradients with value distributions, end to end in JAX.

dgae COMMAND --help lists the flags of a command.
dgae --version prints the versions that results depend on.
dgae --completion bash|zsh|fish prints a script for the shell.

exit codes: 0 done; 1 diverged or could not write; 2 bad input;
            129, 130 or 143 stopped by SIGHUP, SIGINT or SIGTERM

Examples:
  dgae train --env hopper --algo dppo --run-dir runs/first
  dgae evaluate runs/first --episodes 100
  dgae reproduce studies/small --envs hopper --algos ppo dppo --scale 0.1"""

SHELLS = ("bash", "zsh", "fish")

LIBRARIES = ("jax", "mujoco", "mujoco-mjx", "brax", "gymnasium")
"""What results depend on most."""


def command(name: str) -> Callable[[], int]:
    """Return the command of that name."""
    return getattr(import_module(f"dgae_jax.cli.{COMMANDS[name]}"), name)


def main() -> int:
    """Run one command."""
    terminal.prepare()
    words = sys.argv[1:] or ["--help"]
    name, _, value = words[0].partition("=")
    if words[0] in COMMANDS:
        sys.argv = [f"dgae {name}", *words[1:]]
        return command(name)()
    if words[0] == "--version":
        versions = ", ".join(f"{library} {metadata.version(library)}" for library in LIBRARIES)
        terminal.say(f"dgae_jax {dgae_jax.__version__}")
        terminal.say(f"Python {platform.python_version()}, {versions}")
        return 0
    if name == "--completion":
        shell = value or "".join(words[1:2])
        if shell not in SHELLS:
            parse.fail(invalid("completion", shell or "nothing", f"one of {', '.join(SHELLS)}"))
        words = ["--tyro-print-completion", shell]
    parse.arguments(_any_command(), words, description=DESCRIPTION, prog="dgae")
    return 0


def _any_command() -> Any:
    """Return the type of which tyro makes the help, the completion and the message of a mistake."""
    kinds = []
    for name in COMMANDS:
        flags = command(name).arguments  # pyright: ignore[reportFunctionMemberAccess]
        purpose = (inspect.getdoc(flags) or "").partition("\n")[0]
        kinds.append(Annotated[flags, tyro.conf.subcommand(name, description=purpose)])
    return Union[tuple(kinds)]  # noqa: UP007


if __name__ == "__main__":
    sys.exit(main())
