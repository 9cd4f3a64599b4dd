"""How a dataclass becomes flags: every value of it, under which heading the help lists it, and how its default is written.

tyro parses, and lays the help out. It lists flags by the dataclass they are in, with prefixes; a run's settings are few dataclasses and
many headings. So tyro is shown another dataclass, which is made of the same values (`view`), and what it parsed is put back (`built`).
"""

import functools
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, field, fields, is_dataclass, make_dataclass
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import docstring_parser
import tyro

from dgae_jax.configs.config import flag

Route = tuple[str, ...]
"""Names of attributes, from a dataclass down to a value of it."""

GROUPS = {
    "task": ("env", "env_version", "physics", "episode_length"),
    "noise": (),
    "algorithm": (
        "algo",
        "gamma",
        "lam",
        "residual",
        "metric",
        "normalize_observations",
        "normalize_rewards",
    ),
    "rollout": ("total_steps", "num_envs", "num_steps", "seed", "num_seeds"),
    "policy": (),
    "critic": (),
    "run": (
        "run_dir",
        "resume",
        "resume_or_start",
        "inexact",
        "checkpoint_every",
        "keep_checkpoints",
        "log",
        "cache_dir",
    ),
    "evaluation": ("eval_engine", "episodes"),
    "device": ("devices", "coordinator", "num_processes", "process_id"),
    "diagnostics": ("diagnostics", "max_nonfinite", "debug_nonfinite"),
}
"""Headings of the help, in order, and the settings below them; what is in a dataclass of its own (policy.clip_eps) is below its name."""

_GROUP_OF = {setting: group for group, settings in GROUPS.items() for setting in settings}


class Leaf(NamedTuple):
    """A value that a flag sets."""

    route: Route
    flag: str
    """Without its dashes; of a positional argument its name."""
    group: str
    """Heading of the help; empty for what is of the command itself."""
    about: str
    """What stands below the heading."""
    hint: Any
    """Type, with tyro's annotations."""
    text: str
    default: Any
    """MISSING where there must be one."""

    @property
    def attribute(self) -> str:
        """Name in the view."""
        return "_".join(self.route)

    @property
    def positional(self) -> bool:
        """Whether it is written without a flag."""
        return tyro.conf.Positional in getattr(self.hint, "__metadata__", ())


def leaves(cls: type, default: Any = None, route: Route = (), prefix: str = "") -> Iterator[Leaf]:
    """All values of a dataclass, with the defaults of `default` where it is given."""
    hints, plain, texts = get_type_hints(cls, include_extras=True), get_type_hints(cls), _texts(cls)
    for f in fields(cls):
        hint, here, value = hints[f.name], (*route, f.name), _default(f, default)
        if is_dataclass(plain[f.name]):
            inside = (
                "" if get_origin(hint) is Annotated else f"{prefix}{f.name}."
            )  # annotated with an empty name
            yield from leaves(plain[f.name], None if value is MISSING else value, here, inside)
        else:
            group = _GROUP_OF.get(f.name, route[-1]) if route and not prefix else prefix.rstrip(".")
            about = cls.__doc__ or "" if group not in _GROUP_OF.values() and route else ""
            yield Leaf(
                here, flag(prefix + f.name)[2:], group, about, hint, texts.get(f.name, ""), value
            )


def _default(f: Any, default: Any) -> Any:
    if default is not None:
        return getattr(default, f.name)
    return f.default_factory() if f.default_factory is not MISSING else f.default


@functools.cache
def _texts(cls: type) -> dict[str, str]:
    """What stands below each field."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__[:-1]):
        for entry in docstring_parser.parse_from_object(base).params:
            texts[entry.arg_name] = re.sub(r"\s+", " ", entry.description or "")
    return texts


def view(listed: Iterable[Leaf]) -> type:
    """The dataclass that tyro is shown: one dataclass inside it per heading."""
    groups: dict[str, list[Leaf]] = {"": [], **{name: [] for name in GROUPS}}
    for leaf in listed:
        groups.setdefault(leaf.group, []).append(leaf)
    members = [_member(leaf) for leaf in groups.pop("")]
    for name, inside in groups.items():
        if inside:
            group = make_dataclass(name, map(_member, inside), kw_only=True, frozen=True)
            members.append(
                (
                    name,
                    Annotated[group, tyro.conf.arg(help=inside[0].about)],
                    field(default_factory=group),
                )
            )
    return make_dataclass("Arguments", members, kw_only=True, frozen=True)


def _member(leaf: Leaf) -> tuple[str, Any, Any]:
    named = leaf.flag.replace("-", "_").upper() if leaf.positional else ""
    shown = tyro.conf.arg(
        name=leaf.flag, prefix_name=False, help=leaf.text, metavar=metavar(leaf.hint, named), help_behavior_hint=_hint(leaf.default),
    )  # fmt: skip
    return (
        leaf.attribute,
        Annotated[leaf.hint, shown],
        field() if leaf.default is MISSING else field(default=leaf.default),
    )


def metavar(hint: Any, named: str = "") -> str | None:
    """What stands for the value of a flag: INT, PATH, {latest,best}, or INT ... for several; None where the flag has no value."""
    origin, inside = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return metavar(inside[0], named)
    if origin is tuple:
        return f"{metavar(inside[0], named)} ..."
    if origin in (Union, UnionType):
        return metavar(next(kind for kind in inside if kind is not type(None)), named)
    if hint is bool:
        return None
    return named or ("{" + ",".join(inside) + "}" if origin is Literal else hint.__name__.upper())


def _hint(value: Any) -> str:
    """The default as it can be typed; the text of a flag says what happens where it is unset."""
    if value is MISSING:
        return "(required)"
    if value is None or value == ():
        return "(unset)"
    return f"(default: {_typed(value)})"


def _typed(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(_typed, value))
    forms = {bool: "yes" if value else "no", int: "{:_}", float: "{:g}"}
    return forms.get(type(value), "{}").format(value)


def built(cls: type, parsed: Any, route: Route = ()) -> Any:
    """The dataclass of which `parsed` is the view."""
    return _built(cls, dict(_values(parsed)), route)


def _values(parsed: Any) -> Iterator[tuple[str, Any]]:
    for f in fields(parsed):
        value = getattr(parsed, f.name)
        yield from _values(value) if is_dataclass(value) else [(f.name, value)]


def _built(cls: type, values: Mapping[str, Any], route: Route) -> Any:
    hints = get_type_hints(cls)
    inside = {f.name: (*route, f.name) for f in fields(cls)}
    return cls(
        **{
            name: _built(hints[name], values, at)
            if is_dataclass(hints[name])
            else values["_".join(at)]
            for name, at in inside.items()
        }
    )
