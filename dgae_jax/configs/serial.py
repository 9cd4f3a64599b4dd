"""A configuration as plain data, for JSON: written whole, read strictly."""

import dataclasses
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from dgae_jax.configs.config import Config, ConfigError

SCHEMA = 2
"""Version of the data; 1 had no number, and its physics `mjx` was the engine that is called `jax` now."""

MAY_CHANGE = ("total_steps", "physics")
"""What of a configuration may change between the parts of one run."""


def to_dict(config: Config) -> dict[str, Any]:
    """Plain data with the schema's number."""
    return {"schema": SCHEMA, **dataclasses.asdict(config)}


def from_dict(data: Any) -> Config:
    """The configuration written by `to_dict`; raises ConfigError for another schema, missing or unknown names and wrong types."""
    if not isinstance(data, dict):
        raise ConfigError(f"configuration: must be an object, not {data!r}")
    schema, fields = data.get("schema"), {name: value for name, value in data.items() if name != "schema"}
    if schema is None and "env" in data:
        raise ConfigError(f"schema: missing; before schema {SCHEMA} the engine now called jax had the name mjx, which is MuJoCo's own now")
    if type(schema) is not int or schema != SCHEMA:
        raise ConfigError(f"schema {schema}: must be {SCHEMA}")
    return _from_dict(Config, fields, "")


def check_types(config: Config) -> None:
    """Raise ConfigError for a setting of the wrong type; arrays pass for numbers, because they may be traced."""
    _check_types(config, "")


def _check_types(settings: Any, prefix: str) -> None:
    for name, kind in get_type_hints(type(settings)).items():
        value = getattr(settings, name)
        if dataclasses.is_dataclass(kind):
            if not isinstance(value, kind):  # pyright: ignore[reportArgumentType]
                raise ConfigError(f"{prefix}{name} {value!r}: must be {kind.__name__}", prefix + name)
            _check_types(value, f"{prefix}{name}.")
        elif not hasattr(value, "dtype"):
            _value(value, kind, prefix + name)


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings by their path, of plain data."""
    nested = (flat(v, f"{prefix}{k}.") if isinstance(v, dict) else {prefix + k: v} for k, v in values.items())
    return {path: value for each in nested for path, value in each.items()}


def differences(one: Config, two: Config) -> dict[str, tuple[Any, Any]]:
    """The fields, by path, in which two configurations differ, with both values."""
    ours, theirs = flat(to_dict(one)), flat(to_dict(two))
    return {path: (value, theirs[path]) for path, value in ours.items() if value != theirs[path]}


def _from_dict(cls: type, data: Any, prefix: str) -> Any:
    if not isinstance(data, dict):
        raise ConfigError(f"{prefix.rstrip('.')}: must be an object, not {data!r}")
    kinds = get_type_hints(cls)
    for name in sorted(set(data) ^ set(kinds)):
        raise ConfigError(f"{prefix}{name}: {'unknown' if name in data else 'missing'}")
    return cls(**{name: _value(data[name], kind, prefix + name) for name, kind in kinds.items()})


def _value(value: Any, kind: Any, path: str) -> Any:
    if dataclasses.is_dataclass(kind):
        return _from_dict(kind, value, path + ".")  # pyright: ignore[reportArgumentType]
    if isinstance(kind, UnionType):
        if value is None:
            return None
        kind = get_args(kind)[0]
    if get_origin(kind) is tuple and isinstance(value, list | tuple) and all(type(v) is int for v in value):
        return tuple(value)
    if kind is float and type(value) is int and abs(value) < 2**53:
        return float(value)
    if type(value) is not kind:
        raise ConfigError(f"{path}: must be {getattr(kind, '__name__', kind)}, not {value!r}", path)
    return value
