"""The console command: `dgae COMMAND …` is `python experiments/COMMAND.py …`."""

import platform
import sys
from difflib import get_close_matches
from importlib import import_module, metadata

import dgae_jax
from dgae_jax.run import terminal

COMMANDS = {
    "train": "train a policy and write a run directory",
    "evaluate": "evaluate the policy of a run directory, or of a file",
    "calibrate": "compare the critic of run directories with the returns that came",
    "refit": "fit a value distribution to a policy that is held fixed",
    "reproduce": "train all of a study: tasks, algorithms and seeds",
    "report": "figures, tables and one page from the results of studies",
    "tune": "search for the settings with the highest return",
    "render": "make a film of the policy of a run directory",
    "export": "take a policy out, as NumPy, ONNX or an agent of Gymnasium",
    "figures": "draw the robots and the transport of mass",
}
"""Each is a module of this room with a `main`."""

USAGE = """usage: dgae COMMAND [flags]

Policy gradients with value distributions, end to end in JAX.

commands:
{commands}

flags:
  -h, --help         this; dgae COMMAND --help lists the flags of a command
  --version          the versions of this package and of those that it stands on
  --completion SHELL
                     a script that completes commands, flags and names in bash,
                     zsh or fish: source <(dgae --completion bash)

exit codes: 0 done; 1 broke down; 2 bad input, one line on stderr;
            129, 130 or 143 stopped by SIGHUP, SIGINT or SIGTERM

examples:
{examples}"""

EXAMPLES = (
    "dgae train --env hopper --algo dppo --run-dir runs/first",
    "dgae evaluate runs/first --episodes 100",
    "dgae reproduce studies/small --envs hopper --algos ppo dppo --scale 0.1",
)

LIBRARIES = ("jax", "mujoco", "mujoco-mjx", "brax", "gymnasium")
"""What results depend on most."""


def main() -> int:
    """Run one command; 2 for an unknown name."""
    terminal.prepare()
    words = sys.argv[1:]
    name = words[0] if words else "--help"
    if name in ("-h", "--help"):
        terminal.say(_usage())
        return 0
    if name == "--version":
        versions = ", ".join(f"{library} {metadata.version(library)}" for library in LIBRARIES)
        terminal.say(
            f"dgae_jax {dgae_jax.__version__}\nPython {platform.python_version()}, {versions}"
        )
        return 0
    if name.partition("=")[0] == "--completion":
        return _completion(name.partition("=")[2] or "".join(words[1:2]))
    if name not in COMMANDS:
        near = get_close_matches(name, COMMANDS, n=1)
        meant = f"; perhaps {near[0]}" if near else ""
        terminal.warn(f"error: {ascii(name)[1:-1]}: must be one of {', '.join(COMMANDS)}{meant}")
        return 2
    sys.argv = [f"dgae {name}", *words[1:]]
    return import_module(f"dgae_jax.cli.{name}").main()


def _usage() -> str:
    commands = "\n".join(f"  {name:10s} {purpose}" for name, purpose in COMMANDS.items())
    return USAGE.format(commands=commands, examples="\n".join(f"  {line}" for line in EXAMPLES))


def _completion(shell: str) -> int:
    from dgae_jax.cli import arguments, completion

    try:
        terminal.say(completion.script(shell, COMMANDS).rstrip("\n"))
    except ValueError as mistake:
        arguments.fail(mistake)
    return 0


if __name__ == "__main__":
    sys.exit(main())
