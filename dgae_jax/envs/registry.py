"""The tasks by name: where each is built, what it runs on, who evaluates it.

Importing this loads no task, so that names can be checked before JAX, MuJoCo and Brax are imported.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

from dgae_jax.physics.registry import ENGINES

if TYPE_CHECKING:
    from dgae_jax.envs.base import Env

BRAX = "brax:"
"""Before the name of an environment of Brax's own."""
PLAYGROUND = "playground:"
"""Before the name of a task of MuJoCo Playground."""
GYMNASIUM = "gymnasium:"
"""Before the id of a task of Gymnasium."""
CUSTOM = "custom:"
"""Before the name of the class of an environment that is given as an object."""

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
    gymnasium_id: str | None = None
    """Gymnasium's id of a task that is one of Gymnasium's and has no versions here."""
    on_host: bool = False
    """Whether its worlds are Python objects on the host: for a CPU, a single device, and no exact resume."""

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
        return self.referees[version or self.versions[0]] if self.referees else self.gymnasium_id

    def choose(
        self, physics: str | None = None, version: str | None = None
    ) -> tuple[str, str | None]:
        """Engine and version, with the defaults filled in; raises ValueError, naming what is allowed."""
        physics = self.default_engine if physics is None else physics
        version = self.default_version if version is None else version
        if physics not in self.engines:
            raise ValueError(f"physics {physics}: must be one of {', '.join(self.engines)}")
        if version is not None and version not in self.versions:
            raise ValueError(
                f"version {version}: must be {'one of ' + ', '.join(self.versions) if self.versions else 'left out'}"
            )
        return physics, version


def _ours(name: str) -> EnvSpec:
    return EnvSpec(
        f"dgae_jax.envs.gym_tasks:{name}.make",
        (),
        tuple(ENGINES),
        {v: f"{name}-{v}" for v in ("v4", "v5")},
    )


TASKS = {name.lower(): _ours(name) for name in ("Ant", "Hopper", "Swimmer", "Walker2d")}


def _brax(name: str) -> EnvSpec:
    if name not in _brax_names():
        raise ValueError(f"{BRAX}NAME with NAME one of {', '.join(_brax_names())}")
    return EnvSpec("dgae_jax.envs.brax:make", (name,), ("mjx",), {})


def _brax_names() -> list[str]:
    """Brax's own names and those that somebody registered with it."""
    brax: Any = sys.modules.get("brax.envs")
    registered = (
        ()
        if brax is None
        else (n for n in brax._envs if not n.startswith("dgae_") and n != "swimmer")
    )
    return sorted({*BRAX_NAMES, *registered})


def _playground(name: str) -> EnvSpec:
    if find_spec("mujoco_playground") is None:
        raise ValueError(
            'used with the package playground, which is not installed: pip install "dgae_jax[playground]"'
        )
    return EnvSpec("dgae_jax.envs.playground:make", (name,), ("mjx", "mjx-warp"), {})


def _gymnasium(name: str) -> EnvSpec:
    return EnvSpec(
        "dgae_jax.envs.gymnasium:make", (name,), ("gymnasium",), {}, gymnasium_id=name, on_host=True
    )


GIVEN: dict[str, Any] = {}
"""Environments that were given as objects, by their names with the prefix."""


@contextmanager
def given(env: Any) -> Iterator[str | None]:
    """Let the object `env` be a task while the context lasts, by the name of its class, which is yielded; None does nothing."""
    if env is None:
        yield None
        return
    name = CUSTOM + type(getattr(env, "unwrapped", env)).__name__
    before, GIVEN[name] = GIVEN.get(name), env
    try:
        yield name
    finally:
        del GIVEN[name]
        if before is not None:
            GIVEN[name] = before


def _custom(name: str) -> EnvSpec:
    if CUSTOM + name not in GIVEN:
        raise ValueError(
            "given as an object from Python: dgae_jax.train(config, run_dir, env=…), load_policy(run_dir, env=…)"
        )
    return EnvSpec("dgae_jax.envs.given:make", (name,), ("custom",), {})


PREFIXES: dict[str, Callable[[str], EnvSpec]] = {
    BRAX: _brax,
    PLAYGROUND: _playground,
    GYMNASIUM: _gymnasium,
    CUSTOM: _custom,
}
"""Whose tasks a name means, and what exists of the one whose name follows; raises ValueError, naming what is allowed."""

NAMES = f"one of {', '.join(TASKS)}, or {BRAX}NAME, {PLAYGROUND}NAME or {GYMNASIUM}ID for a task of somebody else's"
"""What a task's name must be."""


def canonical_name(name: str) -> tuple[str, str | None]:
    """Return a task's name and version as we write them: `Hopper-v4` is `hopper` and `v4`."""
    if name.lower() in TASKS:
        return name.lower(), None
    task, _, version = name.lower().rpartition("-")
    is_version = task in TASKS and version.startswith("v") and version[1:].isdigit()
    return (task, version) if is_version else (name, None)


def spec_of(name: str) -> EnvSpec:
    """What exists of the task `name`; raises ValueError with "one of …" for an unknown one."""
    if name in TASKS:
        return TASKS[name]
    for prefix, of_others in PREFIXES.items():
        if name.startswith(prefix) and name != prefix:
            return of_others(name.removeprefix(prefix))
    raise ValueError(NAMES)


def make_env(
    name: str, *, physics: str | None = None, version: str | None = None, **task_parameters
) -> "Env":
    """The task `name` over the engine `physics`, with Gymnasium's semantics of `version`: by default `jax` and `v4`.

    `task_parameters` are those of Gymnasium's constructor. Tasks of others are `brax:NAME` on `mjx`, `playground:NAME` on `mjx` or
    `mjx-warp`, and `gymnasium:ID`; their parameters are those of their own constructors. Raises ValueError, naming what is allowed,
    for an unknown name, an engine that the task does not run on or that is not installed, and a version that it does not have.
    """
    name, named_version = canonical_name(name)
    if named_version and version not in (None, named_version):
        raise ValueError(f"version {version}: must be {named_version} as in the name, or left out")
    version = version or named_version
    try:
        spec = spec_of(name)
    except ValueError as allowed:
        raise ValueError(f"environment {name}: must be {allowed}") from None
    return resolve_name(spec.builder)(
        *spec.arguments, *spec.choose(physics, version), **task_parameters
    )
