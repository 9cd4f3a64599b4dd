"""What a tuning searches: settings, and the values that each may have. Nothing here imports JAX or Optuna.

`gamma=0.95:0.999` is a range, `policy.learning_rate=log:1e-4:1e-2` one whose logarithm is searched evenly, `num_envs=int:4:64` (or
`int:log:4:64`) one of whole numbers, `critic.minibatches=16,32,64` a choice.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from dgae_jax.configs.config import ConfigError, CriticConfig, PolicyConfig, floats_of, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve

USUAL = ("gamma=0.95:0.9999", "lam=0.5:1")
"""What the paper tuned for each method."""

SAME_FOR_ALL = (
    "env",
    "env_version",
    "algo",
    "physics",
    "seed",
    "num_seeds",
    "total_steps",
    "episode_length",
)
"""What the trials of a tuning share, since it says what is measured."""

LISTED = 1000
"""Ranges of as many whole numbers are looked at number by number."""


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, both of them too."""

    low: float
    high: float
    log: bool = False
    whole: bool = False

    def __contains__(self, value: Any) -> bool:
        return value is not None and self.low <= value <= self.high

    def __str__(self) -> str:
        return f"{'int:' * self.whole}{'log:' * self.log}{self.low:g}:{self.high:g}"

    @property
    def examples(self) -> Sequence[Any]:
        """Values that must be valid for all of them to be."""
        few = self.whole and self.high - self.low < LISTED
        return range(int(self.low), int(self.high) + 1) if few else (self.low, self.high)


@dataclass(frozen=True)
class Choice:
    """One of several values; widths of layers are written `64x64`."""

    values: tuple[Any, ...]

    def __contains__(self, value: Any) -> bool:
        return value in self.values

    def __str__(self) -> str:
        return ",".join(map(str, self.values))

    @property
    def examples(self) -> Sequence[Any]:
        """All of them."""
        return self.values


Space = dict[str, Range | Choice]
"""By the path of each setting."""


def space_of(words: Sequence[str], config: ResolvedConfig) -> Space:
    """What `words` say, checked against the rest of `config`.

    Raises ConfigError for an unknown setting, one that the algorithm does not use, a malformed range and values that are invalid.
    """
    space: Space = {}
    for word in words:
        path, dimension = _dimension(word)
        if path in space:
            raise invalid("search", word, f"the only range of {path}")
        for value in dimension.examples:
            try:
                resolve(with_values(config, {path: value}))
            except ConfigError as reason:
                raise invalid("search", word, f"valid throughout ({reason})") from None
        space[path] = dimension
    return space


def with_values(config: ResolvedConfig, values: dict[str, Any]) -> ResolvedConfig:
    """The configuration with some settings, by path, replaced."""
    for path, value in values.items():
        layers = isinstance(value, str) and _is_layers(_kinds(ResolvedConfig)[path])
        config = _replaced(
            config, path.split("."), tuple(map(int, value.split("x"))) if layers else value
        )
    return config


def values_of(config: ResolvedConfig, space: Space) -> dict[str, Any]:
    """What the configuration has of what is searched, as a trial writes it."""
    values = {}
    for path in space:
        value: Any = config
        for name in path.split("."):
            value = getattr(value, name)
        values[path] = "x".join(map(str, value)) if isinstance(value, tuple) else value
    return values


def is_traced(path: str) -> bool:
    """Whether one compiled program serves all values of a setting."""
    part, _, name = path.rpartition(".")
    cls = {"": ResolvedConfig, "policy": PolicyConfig, "critic": CriticConfig}.get(part)
    return cls is not None and name in floats_of(cls)


def _replaced(settings: Any, path: list[str], value: Any) -> Any:
    name, *rest = path
    return dataclasses.replace(
        settings, **{name: _replaced(getattr(settings, name), rest, value) if rest else value}
    )


def _kinds(cls: type, prefix: str = "") -> dict[str, Any]:
    """The type of every setting, by path."""
    kinds: dict[str, Any] = {}
    for name, kind in get_type_hints(cls).items():
        bare = get_args(kind)[0] if isinstance(kind, UnionType) else kind
        parts = isinstance(bare, type) and dataclasses.is_dataclass(bare)
        kinds |= _kinds(bare, f"{prefix}{name}.") if parts else {prefix + name: bare}
    return kinds


def _is_layers(kind: Any) -> bool:
    return get_origin(kind) is tuple


def _dimension(word: str) -> tuple[str, Range | Choice]:
    name, equals, text = word.partition("=")
    path, kinds = (
        name.replace("-", "_"),
        {path: kind for path, kind in _kinds(ResolvedConfig).items() if path not in SAME_FOR_ALL},
    )
    if not (equals and text):
        raise invalid(
            "search",
            word,
            "SETTING=LOW:HIGH, =log:LOW:HIGH, =int:LOW:HIGH, =int:log:LOW:HIGH or =VALUE,VALUE",
        )
    if path in SAME_FOR_ALL:
        raise invalid("search", word, f"of another setting: all trials have the same {path}")
    if path not in kinds:
        raise invalid("search", word, f"of one of {', '.join(kinds)}")
    return path, (_range if ":" in text else _choice)(word, text, kinds[path])


def _range(word: str, text: str, kind: Any) -> Range:
    *how, low, high = text.split(":")
    if tuple(how) not in ((), ("log",), ("int",), ("int", "log")) or kind not in (int, float):
        raise invalid(
            "search",
            word,
            "LOW:HIGH, log:LOW:HIGH, int:LOW:HIGH or int:log:LOW:HIGH of a setting that is a number",
        )
    if ("int" in how) != (kind is int):
        raise invalid(
            "search",
            word,
            "int:LOW:HIGH, its values are whole"
            if kind is int
            else "without int:, its values are not whole",
        )
    try:
        found = Range(_number(low, kind), _number(high, kind), "log" in how, kind is int)
    except ValueError:
        raise invalid(
            "search", word, f"between {'whole numbers' if kind is int else 'numbers'}, LOW:HIGH"
        ) from None
    if not found.low < found.high:
        raise invalid("search", word, "LOW:HIGH with LOW below HIGH")
    if found.log and found.low <= 0:
        raise invalid("search", word, "above 0, for the sake of its logarithm")
    return found


def _choice(word: str, text: str, kind: Any) -> Choice:
    try:
        values = tuple(_value(each, kind) for each in text.split(","))
    except ValueError:
        raise invalid(
            "search",
            word,
            f"a list of {_NAMES.get(kind, 'widths of layers, 64x64')}, with commas between them",
        ) from None
    if len(set(values)) != len(values) or len(values) < 2:
        raise invalid("search", word, "a list of two or more different values")
    return Choice(values)


_NAMES = {int: "whole numbers", float: "numbers", bool: "true and false", str: "names"}


def _value(text: str, kind: Any) -> Any:
    """A value as Optuna keeps it; raises ValueError."""
    if _is_layers(kind):
        return "x".join(str(int(width)) for width in text.split("x"))
    if kind is bool:
        return (
            {"true": True, "false": False}[text.lower()]
            if text.lower() in ("true", "false")
            else _no_value(text)
        )
    if kind in (int, float):
        return _number(text, kind)
    return text or _no_value(text)


def _no_value(text: str) -> Any:
    raise ValueError(text)


def _number(text: str, kind: type) -> float:
    number = float(text)
    if not math.isfinite(number) or (kind is int and not number.is_integer()):
        raise ValueError(text)
    return kind(number)
