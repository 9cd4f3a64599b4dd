"""The command lines: `dgae COMMAND …` and `python experiments/COMMAND.py …`."""
