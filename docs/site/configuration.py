"""docs/configuration.md from the dataclasses that it describes: python -m docs.site.configuration

The words are the docstrings below the fields, the defaults and what is allowed those of the tables that a configuration is checked by.
"""

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from dgae_jax.cli.train import Arguments
from dgae_jax.configs import algorithms, parts, validation
from dgae_jax.configs.config import Config, CriticConfig, NoiseConfig, PolicyConfig, flag
from dgae_jax.configs.presets import PRESETS, preset
from dgae_jax.envs.registry import TASKS
from dgae_jax.run import options
from dgae_jax.run.options import RunOptions

PAGE = Path(__file__).parent.parent / "configuration.md"
PARTS = {"noise": NoiseConfig, "policy": PolicyConfig, "critic": CriticConfig}
TABLES: Mapping[str, Mapping[str, parts.Part]] = {"policy": parts.UPDATES, "critic": parts.CRITICS}

HEAD = """# Configuration

Every setting of a run, written by `python -m docs.site.configuration` from the dataclasses; a test compares this page with them.
`Config` decides the result, [`RunOptions`](#what-a-run-leaves) what the run leaves on the machine. A setting that is *unset* (None)
is filled in by the algorithm or the task; one that the run's parts do not use must stay unset and is refused otherwise.

The path of a setting in Python is its flag, with underscores or dashes: `Config(policy=PolicyConfig(clip=0.3))` is `--policy.clip_eps-eps 0.3`.
Where the default is `True` or `False`, the flag is written `--name` or `--no-name`.

Settings start from a preset (`--preset`, `dgae_jax.preset`), from a file (`--config`) or, in Python, from `dgae_jax.Config()`; flags
and arguments change single ones. `config.json` in a run directory has all of them, resolved.
"""


def page() -> str:
    """The text of the page."""
    names = [f.name for f in dataclasses.fields(Arguments) if f.name in ("preset", "config")]
    sections = [
        HEAD,
        "## The run\n", _fields(Config, skip=tuple(PARTS)),
        "## The policy\n", _fields(PolicyConfig, "policy."),
        "## The critic\n", _fields(CriticConfig, "critic."),
        "## Noise\n", (NoiseConfig.__doc__ or "") + "\n", _fields(NoiseConfig, "noise."),
        "## What the algorithm fills in\n", _algorithms(),
        "Each part fills in its own settings; those of the others are refused.\n", _filled(),
        "## What the presets change\n",
        "Against `Config()`:\n", _presets(),
        "## Where settings start\n", _fields(Arguments, only=names),
        "## What a run leaves\n", (RunOptions.__doc__ or "") + "\n", _fields(RunOptions, allowed=options.INTEGER_RANGES),
    ]  # fmt: skip
    return "\n".join(sections).rstrip() + "\n"


def _fields(
    cls: type,
    prefix: str = "",
    skip: tuple[str, ...] = (),
    only: list[str] | None = None,
    allowed: Mapping[str, Any] = validation.WHOLE,
) -> str:
    said = {
        name: text for each in reversed(cls.__mro__) for name, text in _docstrings(each).items()
    }
    rows = [
        (
            f"`{flag(prefix + f.name)}`",
            _shown(_default(f)),
            _allowed(prefix + f.name, allowed),
            said[f.name],
        )
        for f in dataclasses.fields(cls)
        if f.name not in skip and (only is None or f.name in only)
    ]
    return _table(("flag", "default", "allowed", "what it is [unit]"), rows)


def _docstrings(cls: type) -> dict[str, str]:
    """The string below each field of a dataclass, on one line."""
    if not dataclasses.is_dataclass(cls):
        return {}
    body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body  # pyright: ignore[reportAttributeAccessIssue]
    found = {}
    for statement, below in pairwise(body):
        if isinstance(statement, ast.AnnAssign) and isinstance(below, ast.Expr):
            found[ast.unparse(statement.target)] = " ".join(ast.literal_eval(below.value).split())
    return found


def _default(f: dataclasses.Field) -> Any:
    return f.default if f.default_factory is dataclasses.MISSING else f.default_factory()


def _allowed(path: str, whole: Mapping[str, Any]) -> str:
    """The limits of a number, or the names of the table that a setting is looked up in."""
    if path in whole:
        low, high, _ = whole[path]
        return f"at least {low}" if high == validation.LARGEST else f"{low:,} to {high:,}"
    tables = {
        **validation.CHOICES,
        "policy.update": parts.UPDATES,
        "critic.kind": parts.CRITICS,
        "algo": algorithms.TABLE,
        "preset": PRESETS,
    }
    if path in tables:
        return ", ".join(f"`{name}`" for name in tables[path])
    return "0 to 1" if path in validation.UNIT else "above 0" if path in validation.POSITIVE else ""


def _algorithms() -> str:
    header = (
        "`--algo`",
        "`--critic.kind`",
        "`--residual`",
        "`--critic.target`",
        "`--policy.update`",
    )
    return _table(
        header,
        [(f"`{name}`", *(f"`{part}`" for part in row)) for name, row in algorithms.TABLE.items()],
    )


def _filled() -> str:
    rows = []
    for group, table in TABLES.items():
        for name, part in table.items():
            settings = {**(parts.DESCENT if group == "critic" else {}), **part.options}
            shown = ", ".join(
                f"`{flag(f'{group}.{key}')} {value}`" for key, value in settings.items()
            )
            rows.append(
                (
                    f"`{flag(group + '.' + ('update' if group == 'policy' else 'kind'))} {name}`",
                    shown,
                )
            )
    return _table(("part", "settings"), rows)


def _presets() -> str:
    """A row for each group of algorithms and tasks, with all settings that a preset changes for the whole of it."""
    cells = [(algo, env) for algo in algorithms.TABLE for env in TASKS]
    rows = []
    for name in PRESETS:
        where: dict[str, list[tuple[str, str]]] = {}
        for algo, env in cells:
            for path, value in _changed(
                preset(name, algo, env), Config(env=env, algo=algo)
            ).items():
                where.setdefault(f"`{flag(path)} {_word(value)}`", []).append((algo, env))
        settings: dict[tuple[tuple[str, str], ...], list[str]] = {}
        for setting, found in where.items():
            for block in _blocks(found):
                settings.setdefault(block, []).append(setting)
        rows += [
            (f"`{name}`", *_cells(found), ", ".join(settings[found]))
            for found in sorted(settings, key=len, reverse=True)
        ]
    return _table(("`--preset`", "algorithms", "tasks", "sets"), rows)


def _changed(config: Any, start: Any, prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for f in dataclasses.fields(config):
        value, before = getattr(config, f.name), getattr(start, f.name)
        if f.name in PARTS:
            out |= _changed(value, before, f"{f.name}.")
        elif value != before:
            out[prefix + f.name] = value
    return out


def _blocks(cells: Sequence[tuple[str, str]]) -> list[tuple[tuple[str, str], ...]]:
    """The cells as blocks of some algorithms × some tasks: algorithms with the same tasks are one."""
    tasks_of = {algo: tuple(env for other, env in cells if other == algo) for algo, _ in cells}
    return [
        tuple((a, env) for a, env in cells if tasks_of[a] == tasks)
        for tasks in dict.fromkeys(tasks_of.values())
    ]


def _cells(cells: Sequence[tuple[str, str]]) -> tuple[str, str]:
    algos, tasks = (list(dict.fromkeys(each)) for each in zip(*cells, strict=True))
    return ("all" if len(algos) == len(algorithms.TABLE) else ", ".join(algos)), (
        "all" if len(tasks) == len(TASKS) else ", ".join(tasks)
    )


def _shown(value: Any) -> str:
    return "unset" if value is None else "none" if value == () else f"`{_word(value)}`"


def _word(value: Any) -> str:
    return (
        " ".join(map(str, value))
        if isinstance(value, tuple)
        else f"{value:_}"
        if type(value) is int
        else str(value)
    )


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return (
        "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
        )
        + "\n"
    )


if __name__ == "__main__":
    PAGE.write_text(page())
