"""Completion of commands, flags and names in a shell: `dgae --completion bash`, made by tyro from what the commands parse."""

import contextlib
import io
from importlib import import_module
from typing import Annotated, Any, Literal, Union, get_origin

import tyro

from dgae_jax.cli.flags import Leaf, leaves, view
from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import Config, flag, invalid
from dgae_jax.configs.parts import CRITICS, UPDATES
from dgae_jax.configs.presets import PRESETS
from dgae_jax.configs.validation import CHOICES, task_spec
from dgae_jax.envs.registry import TASKS
from dgae_jax.physics.registry import ENGINES
from dgae_jax.run.options import METRIC_LOGGERS
from dgae_jax.study.launch import LAUNCHERS

NAMES = {
    "preset": PRESETS, "env": TASKS, "envs": TASKS, "env_version": task_spec(Config()).versions, "algo": ALGORITHMS, "algos": ALGORITHMS,
    "physics": ENGINES, "policy.update": UPDATES, "critic.kind": CRITICS, "log": METRIC_LOGGERS, "launcher": LAUNCHERS, **CHOICES,
}  # fmt: skip
"""Settings that take a name, and the table that it is of."""

_CHOICES = {flag(setting)[2:]: tuple(table) for setting, table in NAMES.items()}

FILES = {
    "bash": """
_dgae() {
  _tyro_dgae "$@"
  [[ -n "${COMPREPLY[*]}" ]] || mapfile -t COMPREPLY < <(compgen -f -- "${COMP_WORDS[COMP_CWORD]}")
}
complete -o filenames -F _dgae dgae
""",
    "zsh": "(( compstate[nmatches] )) || _files\n",
    "fish": "",
}
"""What is added to tyro's script: run directories, which stand without a flag, are completed where no flag begins so."""


_SPLIT = ('COMPREPLY=($(compgen -f -- "$cur"))', 'mapfile -t COMPREPLY < <(compgen -f -- "$cur")')
"""Where tyro's script for bash takes a name with a space for two, and how it is one."""


def script(shell: str, commands: dict[str, str]) -> str:
    """The completion of `dgae` with these commands and what each is for; raises ConfigError for an unknown shell."""
    if shell not in FILES:
        raise invalid("completion", shell or "nothing", f"one of {', '.join(FILES)}")
    kinds = [
        Annotated[
            view(map(_with_choices, leaves_of(name))),
            tyro.conf.subcommand(name, description=purpose),
        ]
        for name, purpose in commands.items()
    ]
    either: Any = Union[tuple(kinds)]  # noqa: UP007
    screen = io.StringIO()
    with contextlib.redirect_stdout(screen), contextlib.suppress(SystemExit):
        tyro.cli(either, prog="dgae", args=["--tyro-print-completion", shell])
    return screen.getvalue().replace(*_SPLIT) + FILES[shell]


def leaves_of(name: str) -> list[Leaf]:
    """What a command parses, and what it leaves to dgae train to parse."""
    module = import_module(f"dgae_jax.cli.{name}")
    ours = {leaf.flag: leaf for leaf in leaves(module.Arguments)}
    theirs = {leaf.flag: leaf for cls in getattr(module, "REST", ()) for leaf in leaves(cls)}
    return list((theirs | ours).values())


def _with_choices(leaf: Leaf) -> Leaf:
    names = _CHOICES.get(leaf.flag)
    if names is None:
        return leaf
    return leaf._replace(
        hint=tuple[Literal[names], ...] if get_origin(leaf.hint) is tuple else Literal[names]
    )
