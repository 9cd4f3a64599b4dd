"""Write docs/configuration.md from the dataclasses: python -m docs.site.configuration"""

import ast
import dataclasses
import inspect
import textwrap
from itertools import pairwise
from pathlib import Path
from typing import Any

from dgae_jax.configs import parts
from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import (
    CommonConfig,
    Config,
    CriticConfig,
    FitConfig,
    NoiseConfig,
    PolicyConfig,
    flag,
)
from dgae_jax.configs.presets import PRESETS, preset
from dgae_jax.envs.registry import TASKS
from dgae_jax.run.options import RunOptions

PAGE = Path(__file__).parent.parent / "configuration.md"

HEAD = """# Configuration

Written by `python -m docs.site.configuration` from the dataclasses.

A setting's path is its flag: `config.replace(**{"policy.clip_eps": 0.3})` is
`--policy.clip-eps 0.3`; booleans are `--name` or `--no-name`. Settings start from `--preset tuned`
or `paper`, from `--config FILE` or, in Python, from `dgae_jax.Config()`. *Unset* ones are filled
in; one without effect is an error. Former names are still read.
"""


def page() -> str:
    """Return the text of the page."""
    policy = [f for f in dataclasses.fields(PolicyConfig) if f.name not in _names(FitConfig)]
    critic = [f for f in dataclasses.fields(CriticConfig) if f.name not in _names(FitConfig)]
    run = [f for f in dataclasses.fields(Config) if f.name not in ("noise", "policy", "critic")]
    sections = (
        HEAD,
        "## The run\n",
        _fields(run, (CommonConfig, Config)),
        "## Policy and critic\n",
        "Each of these exists as `--policy.NAME` and `--critic.NAME`:\n",
        _fields(dataclasses.fields(FitConfig), (FitConfig,)),
        "## The policy\n",
        _fields(policy, (PolicyConfig,), "policy."),
        "## The critic\n",
        _fields(critic, (CriticConfig,), "critic."),
        "## Noise\n",
        (NoiseConfig.__doc__ or "") + "\n",
        _fields(dataclasses.fields(NoiseConfig), (NoiseConfig,), "noise."),
        "## What the presets change\n",
        "Against `Config()` and the defaults above:\n",
        _presets(),
        "## Files and devices\n",
        "`RunOptions`: none of these changes the result.\n",
        _fields(dataclasses.fields(RunOptions), (RunOptions,)),
    )
    return "\n".join(sections).rstrip() + "\n"


def _names(cls: type) -> set[str]:
    return {f.name for f in dataclasses.fields(cls)}


def _fields(fields: Any, classes: tuple[type, ...], prefix: str = "") -> str:
    said = {name: text for cls in classes for name, text in _docstrings(cls).items()}
    rows = [(f"`{flag(prefix + f.name)}`", _default(f), said[f.name]) for f in fields]
    return _table(("flag", "default", "meaning [unit]"), rows)


def _docstrings(cls: type) -> dict[str, str]:
    """Return the string below each field of a dataclass."""
    tree: Any = ast.parse(textwrap.dedent(inspect.getsource(cls)))
    return {
        ast.unparse(field.target): " ".join(ast.literal_eval(below.value).split())
        for field, below in pairwise(tree.body[0].body)
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr)
    }


def _default(f: dataclasses.Field) -> str:
    """Return the default of a field; where it is unset, what the parts fill in."""
    value = f.default if f.default_factory is dataclasses.MISSING else f.default_factory()
    if value is None:
        options = ({"SGD": parts.SGD} | parts.UPDATES | parts.CRITICS).values()
        filled = dict.fromkeys(each[f.name] for each in options if f.name in each)
        return " or ".join(f"`{_word(each)}`" for each in filled) or "unset"
    return f"`{_word(value)}`" if value != () else "none"


def _word(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return f"{value:_}" if type(value) is int else str(value)


def _presets() -> str:
    """Return a row per preset, algorithms and tasks, with the settings that all of them change."""
    rows = []
    for name in PRESETS:
        where: dict[str, dict[str, list[str]]] = {}
        for algo in ALGORITHMS:
            for env in TASKS:
                start = Config(env=env).replace(algo=algo)
                for setting in _changed(preset(name, algo, env), start):
                    where.setdefault(setting, {}).setdefault(algo, []).append(env)
        groups: dict[tuple[str, str], list[str]] = {}
        for setting, tasks_of in where.items():
            for tasks in dict.fromkeys(map(tuple, tasks_of.values())):
                algos = [algo for algo, found in tasks_of.items() if tuple(found) == tasks]
                block = _shown(algos, ALGORITHMS), _shown(tasks, TASKS)
                groups.setdefault(block, []).append(setting)
        rows += [(f"`{name}`", *block, ", ".join(found)) for block, found in groups.items()]
    return _table(("`--preset`", "algorithms", "tasks", "sets"), rows)


def _shown(names: Any, everything: Any) -> str:
    return "all" if len(names) == len(everything) else ", ".join(names)


def _changed(config: Any, start: Any, prefix: str = "") -> list[str]:
    found = []
    for f in dataclasses.fields(config):
        value, before = getattr(config, f.name), getattr(start, f.name)
        if dataclasses.is_dataclass(value):
            found += _changed(value, before, f"{f.name}.")
        elif value != before:
            found.append(f"`{flag(prefix + f.name)} {_word(value)}`")
    return found


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    escaped = (" | ".join(cell.replace("|", "\\|") for cell in line) for line in lines)
    return "\n".join(f"| {line} |" for line in escaped) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
