"""The tasks by name: builder, engines, and the Gymnasium env that evaluates them.

Importing this loads no task: names are checked before JAX, MuJoCo and Brax are imported.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

from dgae_jax.physics.registry import ENGINES

if TYPE_CHECKING:
    from dgae_jax.envs.base import Env

BRAX, PLAYGROUND, GYMNASIUM, CUSTOM = "brax:", "playground:", "gymnasium:", "custom:"
"""Prefixes of third-party tasks, and of envs that are given as objects."""

BRAX_NAMES = (
    "ant", "fast", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_pendulum",
    "inverted_double_pendulum", "pusher", "reacher", "walker2d",
)  # fmt: skip
"""Brax's own environments that it builds on its MJX backend; its swimmer is not one of them."""

CUSTOM_ENVS: dict[str, Any] = {}
"""Envs that were given as objects, by their names with the prefix."""


class EnvSpec(NamedTuple):
    """A task that can be built and evaluated."""

    build: Callable[..., "Env"]
    """Called with physics, version and task parameters."""
    engines: tuple[str, ...]
    """Engines that the task runs on; the first is the default."""
    eval_envs: Mapping[str, str]
    """Gymnasium's id for each version, the default first; empty for a task without versions."""
    gymnasium_id: str | None = None
    """Gymnasium's id of a third-party task of Gymnasium."""
    on_host: bool = False
    """True if its envs are Python objects: for a CPU, a single device, and no exact resume."""

    @property
    def default_engine(self) -> str:
        """The engine where none is named."""
        return self.engines[0]

    @property
    def default_version(self) -> str | None:
        """The version where none is named; None for a task without versions."""
        return next(iter(self.eval_envs), None)

    @property
    def versions(self) -> tuple[str, ...]:
        """Gymnasium's versions of the task; empty where it has none."""
        return tuple(self.eval_envs)

    def eval_env(self, version: str | None = None) -> str | None:
        """Return Gymnasium's id of the evaluation env; None if the task evaluates itself."""
        return self.eval_envs[version or self.versions[0]] if self.versions else self.gymnasium_id

    def choose(
        self, physics: str | None = None, version: str | None = None
    ) -> tuple[str, str | None]:
        """Return engine and version, with the defaults filled in.

        Raises:
            ValueError: if the task does not have them.
        """
        physics = self.default_engine if physics is None else physics
        version = self.default_version if version is None else version
        if physics not in self.engines:
            raise ValueError(f"physics {physics}: must be one of {', '.join(self.engines)}")
        if version is not None and version not in self.versions:
            allowed = f"one of {', '.join(self.versions)}" if self.versions else "left out"
            raise ValueError(f"version {version}: must be {allowed}")
        return physics, version


def _gym_task(name: str) -> EnvSpec:
    def build(physics, version, **task_parameters) -> "Env":
        from dgae_jax.envs.gym_tasks import GYM_TASKS

        return GYM_TASKS[name.lower()].make(physics, version, **task_parameters)

    return EnvSpec(build, tuple(ENGINES), {v: f"{name}-{v}" for v in ("v4", "v5")})


TASKS = {
    "ant": _gym_task("Ant"),
    "hopper": _gym_task("Hopper"),
    "swimmer": _gym_task("Swimmer"),
    "walker2d": _gym_task("Walker2d"),
}


def _brax(name: str) -> EnvSpec:
    brax: Any = sys.modules.get("brax.envs")
    registered = () if brax is None else brax._envs  # by users too
    names = {*BRAX_NAMES, *(n for n in registered if not n.startswith("dgae_"))} - {"swimmer"}
    if name not in names:
        raise ValueError(f"{BRAX}NAME with NAME one of {', '.join(sorted(names))}")

    def build(physics, version, **task_parameters) -> "Env":
        from dgae_jax.envs.custom import make_brax

        return make_brax(name, physics, **task_parameters)

    return EnvSpec(build, ("mjx",), {})


def _playground(name: str) -> EnvSpec:
    if find_spec("mujoco_playground") is None:
        install = 'pip install "dgae_jax[playground]"'
        raise ValueError(f"used with the package playground, which is not installed: {install}")

    def build(physics, version, **task_parameters) -> "Env":
        from dgae_jax.envs.playground import make_playground

        return make_playground(name, physics, **task_parameters)

    return EnvSpec(build, ("mjx", "mjx-warp"), {})


def _gymnasium(name: str) -> EnvSpec:
    def build(physics, version, **task_parameters) -> "Env":
        from dgae_jax.envs.gymnasium import GymnasiumTask

        return GymnasiumTask(name, **task_parameters)

    return EnvSpec(build, ("gymnasium",), {}, gymnasium_id=name, on_host=True)


def _custom(name: str) -> EnvSpec:
    env = CUSTOM_ENVS.get(CUSTOM + name)
    if env is None:
        calls = "dgae_jax.train(config, run_dir, env=…), load_policy(run_dir, env=…)"
        raise ValueError(f"given as an object from Python: {calls}")

    def build(physics, version) -> "Env":
        from dgae_jax.envs.custom import make_custom

        return make_custom(env)

    return EnvSpec(build, ("custom",), {})


PREFIXES = {BRAX: _brax, PLAYGROUND: _playground, GYMNASIUM: _gymnasium, CUSTOM: _custom}
"""Lookup of the name after a prefix; raises ValueError with "one of …" for an unknown one."""

NAMES = f"one of {', '.join(TASKS)}, or brax:NAME, playground:NAME or gymnasium:ID"
"""The names that a task may have, for messages."""


@contextmanager
def custom_env(env: Any) -> Iterator[str | None]:
    """Register an env object, if any, as a task while the context lasts; yield its name."""
    if env is None:
        yield None
        return
    name = CUSTOM + type(getattr(env, "unwrapped", env)).__name__
    before, CUSTOM_ENVS[name] = CUSTOM_ENVS.get(name), env
    try:
        yield name
    finally:
        del CUSTOM_ENVS[name]
        if before is not None:
            CUSTOM_ENVS[name] = before


def canonical_name(name: str) -> tuple[str, str | None]:
    """Return a task's name and version as we write them: `Hopper-v4` is `hopper` and `v4`."""
    if name.lower() in TASKS:
        return name.lower(), None
    task, _, version = name.lower().rpartition("-")
    is_version = task in TASKS and version.startswith("v") and version[1:].isdigit()
    return (task, version) if is_version else (name, None)


def spec_of(name: str) -> EnvSpec:
    """Return the spec of a task.

    Raises:
        ValueError: with "one of …", if the task is unknown.
    """
    if name in TASKS:
        return TASKS[name]
    for prefix, lookup in PREFIXES.items():
        if name.startswith(prefix) and name != prefix:
            return lookup(name.removeprefix(prefix))
    raise ValueError(NAMES)


def make_env(
    name: str, *, physics: str | None = None, version: str | None = None, **task_parameters
) -> "Env":
    """Build a task.

    Args:
        name: `ant`, `hopper`, `swimmer`, `walker2d`, `brax:NAME`, `playground:NAME` or
            `gymnasium:ID`.
        physics: key of `ENGINES`; by default the first that the task runs on, `jax` for ours.
        version: Gymnasium's version of the task, `v4` (default) or `v5`.
        **task_parameters: those of Gymnasium's constructor, or of the third-party one.

    Raises:
        ValueError: if the task is unknown, does not run on the engine, or the engine is not
            installed.
    """
    name, named_version = canonical_name(name)
    if named_version and version not in (None, named_version):
        raise ValueError(f"version {version}: must be {named_version} as in the name, or left out")
    try:
        spec = spec_of(name)
    except ValueError as allowed:
        raise ValueError(f"environment {name}: must be {allowed}") from None
    return spec.build(*spec.choose(physics, version or named_version), **task_parameters)
