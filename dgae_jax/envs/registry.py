"""The tasks by name: engines, versions, and the Gymnasium env that evaluates them.

Importing this loads no task: names are checked before JAX, MuJoCo and Brax are imported.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

from dgae_jax.physics.registry import ENGINES

if TYPE_CHECKING:
    from dgae_jax.envs.base import Env

CUSTOM_ENVS: dict[str, Any] = {}
"""Envs that were given as objects, by their names with the prefix `custom:`."""


class EnvSpec(NamedTuple):
    """A task that can be built and evaluated."""

    engines: tuple[str, ...]
    """Engines that the task runs on; the first is the default."""
    eval_envs: Mapping[str, str] = {}
    """Gymnasium's id for each version, the default first; empty for a task without versions."""
    gymnasium_id: str | None = None
    """Gymnasium's id of a third-party task of Gymnasium."""

    @property
    def on_host(self) -> bool:
        """True if its envs are Python objects: for a CPU, a single device, and no exact resume."""
        return self.gymnasium_id is not None

    @property
    def default_version(self) -> str | None:
        """The version where none is named; None for a task without versions."""
        return next(iter(self.eval_envs), None)

    def eval_env(self, version: str | None = None) -> str | None:
        """Return Gymnasium's id of the evaluation env; None if the task evaluates itself."""
        return self.eval_envs.get(version or str(self.default_version), self.gymnasium_id)


TASKS = {
    name.lower(): EnvSpec(
        tuple(ENGINES), {version: f"{name}-{version}" for version in ("v4", "v5")}
    )
    for name in ("Ant", "Hopper", "Swimmer", "Walker2d")
}

_THIRD_PARTY = {
    "brax": EnvSpec(("mjx",)),
    "playground": EnvSpec(("mjx", "mjx-warp")),
    "gymnasium": EnvSpec(("gymnasium",)),
    "custom": EnvSpec(("custom",)),
}
"""Third-party tasks by the prefix of their names."""

NAMES = f"one of {', '.join(TASKS)}, or brax:NAME, playground:NAME or gymnasium:ID"
"""The names that a task may have, for messages."""


@contextmanager
def custom_env(env: Any) -> Iterator[str | None]:
    """Register an env object, if any, as a task while the context lasts; yield its name."""
    if env is None:
        yield None
        return
    name = f"custom:{type(getattr(env, 'unwrapped', env)).__name__}"
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
    kind, _, own_name = name.partition(":")
    if not own_name or kind not in _THIRD_PARTY:
        raise ValueError(NAMES)
    if kind == "playground" and find_spec("mujoco_playground") is None:
        install = 'pip install "dgae_jax[playground]"'
        raise ValueError(f"used with the package playground, which is not installed: {install}")
    if kind == "custom" and name not in CUSTOM_ENVS:
        calls = "dgae_jax.train(config, run_dir, env=…), load_policy(run_dir, env=…)"
        raise ValueError(f"given as an object from Python: {calls}")
    return _THIRD_PARTY[kind]._replace(gymnasium_id=own_name if kind == "gymnasium" else None)


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
    engine = spec.engines[0] if physics is None else physics
    version = version or named_version or spec.default_version
    if engine not in spec.engines:
        raise ValueError(f"physics {engine}: must be one of {', '.join(spec.engines)}")
    if version is not None and version not in spec.eval_envs:
        allowed = f"one of {', '.join(spec.eval_envs)}" if spec.eval_envs else "left out"
        raise ValueError(f"version {version}: must be {allowed}")
    if spec.eval_envs:
        task_parameters["version"] = version
    kind, _, own_name = name.partition(":")
    match kind:
        case "brax":
            from dgae_jax.envs.custom import make_brax as build
        case "custom":
            from dgae_jax.envs.custom import make_custom

            return make_custom(CUSTOM_ENVS[name], **task_parameters)
        case "gymnasium":
            from dgae_jax.envs.gymnasium import GymnasiumTask as build
        case "playground":
            from dgae_jax.envs.playground import make_playground as build
        case _:
            from dgae_jax.envs.gym_tasks import make_gym_task as build
    return build(own_name or name, engine, **task_parameters)
