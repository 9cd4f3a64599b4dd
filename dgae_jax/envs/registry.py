"""The tasks by name: where each is built, what it runs on, who evaluates it.

Importing this loads no task, so that names can be checked before JAX, MuJoCo and Brax are imported.
"""

import sys
from collections.abc import Mapping
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

from dgae_jax.physics.registry import ENGINES

if TYPE_CHECKING:
    from dgae_jax.envs.base import Env

BRAX = "brax:"
"""Before the name of an environment of Brax's own."""

BRAX_NAMES = (
    "ant", "fast", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_pendulum", "inverted_double_pendulum",
    "pusher", "reacher", "walker2d",
)  # fmt: skip
"""Environments of Brax's own that it builds on its MJX backend; its swimmer is not one of them."""


class EnvSpec(NamedTuple):
    """What exists of a task."""

    builder: str
    """`module:function` of (*arguments, physics, version, **task_parameters), which returns the environment."""
    arguments: tuple[str, ...]
    engines: tuple[str, ...]
    """Names of the engines it runs on; the first is the default."""
    referees: Mapping[str, str]
    """Gymnasium's id for each version, the first of them the default. Empty for a task without versions, which is evaluated in
    its own engine."""

    @property
    def default_engine(self) -> str:
        """The engine where none is named."""
        return self.engines[0]

    @property
    def versions(self) -> tuple[str, ...]:
        """Gymnasium's versions whose semantics the task has; empty where it has none."""
        return tuple(self.referees)

    @property
    def default_version(self) -> str | None:
        """The version where none is named; None for a task without versions."""
        return next(iter(self.referees), None)

    def referee(self, version: str | None = None) -> str | None:
        """Gymnasium's id of the task that evaluates policies; None: the task itself, in its own engine."""
        return self.referees[version or self.versions[0]] if self.referees else None

    def choose(self, physics: str | None = None, version: str | None = None) -> tuple[str, str | None]:
        """Engine and version, with the defaults filled in; raises ValueError, naming what is allowed."""
        physics = self.default_engine if physics is None else physics
        version = self.default_version if version is None else version
        if physics not in self.engines:
            raise ValueError(f"physics {physics}: must be one of {', '.join(self.engines)}")
        if version is not None and version not in self.versions:
            raise ValueError(f"version {version}: must be {'one of ' + ', '.join(self.versions) if self.versions else 'left out'}")
        return physics, version


def _ours(name: str) -> EnvSpec:
    return EnvSpec(f"dgae_jax.envs.gym_tasks:{name}.make", (), tuple(ENGINES), {v: f"{name}-{v}" for v in ("v4", "v5")})


TASKS = {name.lower(): _ours(name) for name in ("Ant", "Hopper", "Swimmer", "Walker2d")}


def spec_of(name: str) -> EnvSpec:
    """What exists of the task `name`; raises ValueError with "one of …" for an unknown one."""
    if name in TASKS:
        return TASKS[name]
    if name.startswith(BRAX) and name.removeprefix(BRAX) in _brax_names():
        return EnvSpec("dgae_jax.envs.brax:make", (name.removeprefix(BRAX),), ("mjx",), {})
    raise ValueError(f"one of {', '.join(TASKS)}, or {BRAX}NAME with NAME one of {', '.join(_brax_names())}")


def _brax_names() -> list[str]:
    """Brax's own names and those that somebody registered with it."""
    brax: Any = sys.modules.get("brax.envs")
    registered = () if brax is None else (n for n in brax._envs if not n.startswith("dgae_") and n != "swimmer")
    return sorted({*BRAX_NAMES, *registered})


def make_env(name: str, *, physics: str | None = None, version: str | None = None, **task_parameters) -> "Env":
    """The task `name` over the engine `physics`, with Gymnasium's semantics of `version`: by default `jax` and `v4`.

    `task_parameters` are those of Gymnasium's constructor. `brax:NAME` is an environment of Brax's own, on `mjx`; its
    parameters are those of Brax's constructor. Raises ValueError, naming what is allowed, for an unknown name, an engine
    that the task does not run on or that is not installed, and a version that it does not have.
    """
    try:
        spec = spec_of(name)
    except ValueError as allowed:
        raise ValueError(f"environment {name}: must be {allowed}") from None
    return resolve_name(spec.builder)(*spec.arguments, *spec.choose(physics, version), **task_parameters)
