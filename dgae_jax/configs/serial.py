"""Configurations as plain data, for JSON: written whole, read strictly, old schemas upgraded."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from dgae_jax.configs.config import Config, ConfigError, flat
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.validation import check_types

AnyConfig = Config | ResolvedConfig

SCHEMA = 3
"""Version of the data. Schema 1 had no number, and its physics `mjx` is called `jax` now."""

RENAMED = {
    2: {
        "horizon": "num_steps",
        "lam": "gae_lambda",
        "policy.clip": "policy.clip_eps",
        "policy.radius": "policy.max_kl",
        "policy.backtracks": "policy.max_backtracks",
    },
}
"""By schema: the old name of each setting that has another name in the next schema."""

MAY_CHANGE = ("total_steps", "physics")
"""Settings that may differ between a run and its continuation."""


def to_dict(config: AnyConfig) -> dict[str, Any]:
    """Return plain data with the number of the schema; what is unset or unused is None."""
    plain = config.as_config() if isinstance(config, ResolvedConfig) else config
    return {"schema": SCHEMA, **dataclasses.asdict(plain)}


def from_dict(data: Any) -> Config:
    """Return the configuration that `to_dict` wrote, now or by an older version.

    Raises:
        ConfigError: for an unknown schema, missing or unknown names and wrong types.
    """
    values, default = flat(upgraded(data)), Config()
    for path in sorted(set(values) ^ set(flat(dataclasses.asdict(default)))):
        raise ConfigError(f"{path}: {'unknown' if path in values else 'missing'}")
    config = default.replace(**values)
    check_types(config)
    return config


def upgraded(data: Any) -> dict[str, Any]:
    """Return plain data in today's names without its schema; raise ConfigError if it is unknown."""
    if not isinstance(data, dict):
        raise ConfigError(f"configuration: must be an object, not {data!r}")
    schema = data.get("schema")
    if schema is None and "env" in data:
        why = "before schema 2 the engine now called jax had the name mjx"
        raise ConfigError(f"schema: missing; {why}, which is MuJoCo's own now")
    if type(schema) is not int or schema not in (*RENAMED, SCHEMA):
        known = ", ".join(map(str, (*RENAMED, SCHEMA)))
        raise ConfigError(f"schema {schema}: must be one of {known}")
    settings = {name: value for name, value in data.items() if name != "schema"}
    for version in range(schema, SCHEMA):
        settings = _renamed(settings, RENAMED[version])
    return settings


def _renamed(settings: Mapping[str, Any], names: Mapping[str, str], prefix: str = "") -> dict:
    renamed = {}
    for name, value in settings.items():
        new = names.get(prefix + name, name).rpartition(".")[2]
        renamed[new] = _renamed(value, names, f"{name}.") if isinstance(value, dict) else value
    return renamed


def digest(config: AnyConfig) -> str:
    """Return a hash that configurations share which differ in nothing but their seeds."""
    plain = to_dict(dataclasses.replace(config, seed=0, num_seeds=1))
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:12]


def differences(one: AnyConfig, two: AnyConfig) -> dict[str, tuple[Any, Any]]:
    """Return both values of every setting, by path, in which two configurations differ."""
    ours, theirs = flat(to_dict(one)), flat(to_dict(two))
    return {path: (x, theirs[path]) for path, x in ours.items() if x != theirs[path]}
