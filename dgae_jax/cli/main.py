"""The console command: `dgae COMMAND …` is `python experiments/COMMAND.py …`."""

import sys
from importlib import import_module

from dgae_jax.run import terminal

COMMANDS = {
    "train": "train a policy and write a run directory",
    "evaluate": "evaluate the policy of a run directory, or of a file",
    "calibrate": "compare the critic of run directories with the returns that came",
    "reproduce": "train all of a study: tasks, algorithms and seeds",
    "report": "figures, tables and one page from the results of studies",
    "tune": "search for the settings with the highest return",
    "render": "make a film of the policy of a run directory",
    "export": "take the policy of a run directory out, as NumPy, ONNX or an agent of Gymnasium",
    "figures": "draw the robots and the transport of mass",
}
"""Each is a module of this room with a `main`."""


def main() -> int:
    """Run one command; 2 for an unknown name."""
    terminal.prepare()
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        terminal.say("usage: dgae COMMAND [flags]; dgae COMMAND --help lists the flags\n")
        for name, purpose in COMMANDS.items():
            terminal.say(f"  {name:10s} {purpose}")
        return 0
    name = sys.argv[1]
    if name not in COMMANDS:
        terminal.warn(f"error: {ascii(name)[1:-1]}: must be one of {', '.join(COMMANDS)}")
        return 2
    sys.argv = [f"dgae {name}", *sys.argv[2:]]
    return import_module(f"dgae_jax.cli.{name}").main()


if __name__ == "__main__":
    sys.exit(main())
