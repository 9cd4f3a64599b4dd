"""Tasks and physics by name."""

import warnings
from functools import partial
from typing import NamedTuple

import brax.envs
import jax.numpy as jnp
from brax.envs.base import Env, Wrapper
from jaxtyping import Array, Float

from dgae_jax.envs.gym_tasks import Ant, Hopper, Swimmer, Walker2d
from dgae_jax.envs.task import Task, load_spec
from dgae_jax.physics.jax.engine import jax_engine
from dgae_jax.physics.native import native

TASKS: dict[str, type[Task]] = {"ant": Ant, "hopper": Hopper, "swimmer": Swimmer, "walker2d": Walker2d}
PHYSICS = {"jax": jax_engine, "native": native}
VERSIONS = ("v4", "v5")

BRAX = "brax:"
"""Before the name of an environment of Brax's own."""


class EnvSpec(NamedTuple):
    """What exists of a task."""

    engines: tuple[str, ...]
    versions: tuple[str, ...]


def spec_of(name: str) -> EnvSpec:
    """What exists of the task `name`; raises ValueError, saying what is allowed, for an unknown one."""
    if name.startswith(BRAX) and name.removeprefix(BRAX) in brax.envs._envs and not name.startswith(BRAX + "dgae_"):
        return EnvSpec(("mjx",), ())
    if name not in TASKS:
        raise ValueError(f"one of {', '.join(TASKS)}, or {BRAX}NAME with a name that brax.envs knows")
    return EnvSpec(("jax", "native"), VERSIONS)


class BraxTask(Wrapper):
    """An environment of Brax's own, whose actions lie in [−1, 1]."""

    @property
    def action_range(self) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
        """The lowest and highest action."""
        return -jnp.ones(self.action_size), jnp.ones(self.action_size)


def make_env(name: str, *, physics: str | None = "jax", version: str | None = "v4", **task_parameters) -> Env:
    """The task `name` over the physics `physics`, with Gymnasium's semantics of `version` (v4 is Gym's v3).

    `task_parameters` are those of Gymnasium's constructor. `brax:NAME` is an environment of Brax's own, on `mjx`; its
    parameters are those of Brax's constructor. Raises ValueError, naming what exists, for an unknown name.
    """
    if name.startswith(BRAX):
        return _make_brax(name.removeprefix(BRAX), physics, **task_parameters)
    for what, value, table in (("environment", name, TASKS), ("physics", physics, PHYSICS), ("version", version, VERSIONS)):
        if value not in table:
            raise ValueError(f"unknown {what} {value!r}; choose from {', '.join(table)}")
    task = TASKS[name]
    engine = PHYSICS[physics](
        load_spec(task.FILE[version]),
        task.FRAME_SKIP,
        max_contacts=task.CONTACTS,
        contact_forces=task.needs_contact_forces(version, **task_parameters),
    )
    return task(engine, version, **task_parameters)


def _make_brax(name: str, physics: str, **parameters) -> Env:
    if physics != "mjx":
        raise ValueError(f"environments of Brax's own run on mjx, not on {physics}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Brax speaks of features of its model files that it leaves out
            return BraxTask(brax.envs.get_environment(name, backend="mjx", **parameters))
    except KeyError:
        raise ValueError(f"unknown environment {BRAX}{name}; brax.envs knows no {name!r}") from None


for _name in TASKS:  # for Brax's own trainers: brax.envs.get_environment("dgae_hopper", physics="jax")
    brax.envs.register_environment(f"dgae_{_name}", partial(make_env, _name))  # pyright: ignore[reportArgumentType]
