"""Tasks and physics by name."""

from brax.envs.base import Env

from dgae_jax.envs.gym_tasks import Hopper, load_model
from dgae_jax.physics.mjx import mjx
from dgae_jax.physics.native import native

TASKS = {"hopper": Hopper}
PHYSICS = {"mjx": mjx, "native": native}
VERSIONS = ("v4",)


def make_env(name: str, *, physics: str = "mjx", version: str = "v4", **task_parameters) -> Env:
    """The task `name` over the physics `physics`, with Gymnasium's semantics of `version` (v4 is Gym's v3).

    `task_parameters` are those of Gymnasium's constructor. Raises ValueError, naming what exists, for an unknown name.
    """
    for what, value, table in (("environment", name, TASKS), ("physics", physics, PHYSICS), ("version", version, VERSIONS)):
        if value not in table:
            raise ValueError(f"unknown {what} {value!r}; choose from {', '.join(table)}")
    task = TASKS[name]
    return task(PHYSICS[physics](load_model(task.FILE), task.FRAME_SKIP), **task_parameters)
