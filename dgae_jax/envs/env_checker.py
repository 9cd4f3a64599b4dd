"""Check of an environment on shapes, before anything is compiled."""

from typing import Any

import jax
import jax.numpy as jnp

from dgae_jax.envs.base import Env


def check_env(env: Env) -> None:
    """Check that reset and step are as `brax.envs.base.Env` declares them.

    Observations must be one array with one axis, rewards and `done` real numbers, and a step must
    preserve the structure of the state.

    Raises:
        ValueError: with the reason in one line.
    """
    action = jax.ShapeDtypeStruct((_size(env, "action_size"),), jnp.zeros(()).dtype)
    before = _traced("reset", env.reset, jax.random.key(0))
    after = _traced("step", env.step, before, action)
    for state, where in ((before, "reset"), (after, "step")):
        if getattr(state.obs, "shape", None) != (_size(env, "observation_size"),):
            found = f"the observation of its {where} has shape {_shapes(state.obs)}"
            raise ValueError(f"{found}, and must be one array [observation_size]")
        for name in ("reward", "done"):
            value = getattr(state, name)
            if getattr(value, "shape", None) != () or not jnp.issubdtype(value.dtype, jnp.floating):
                found = f"the {name} of its {where} is {value}"
                raise ValueError(f"{found}, and must be a single real number")
    _check_structure(before, after)


def _size(env: Env, name: str) -> int:
    size = getattr(env, name)
    if not isinstance(size, int):
        raise ValueError(f"its {name} is {size!r}, and must be a whole number")
    return size


def _traced(name: str, function: Any, *arguments: Any) -> Any:
    try:
        return jax.eval_shape(function, *arguments)
    except Exception as reason:  # third-party code may raise anything
        line = f"{type(reason).__name__}: {str(reason).partition(chr(10))[0]}"
        raise ValueError(f"its {name} cannot be compiled by JAX ({line})") from reason


def _check_structure(before: Any, after: Any) -> None:
    flatten = jax.tree_util.tree_flatten_with_path
    leaves, new_leaves = (dict(flatten(state)[0]) for state in (before, after))
    for path in leaves | new_leaves:
        old, new = (_shapes(each.get(path)) for each in (leaves, new_leaves))
        if old != new:
            found = f"its step turns state{jax.tree_util.keystr(path)} from {old} into {new}"
            raise ValueError(f"{found}, and must leave it as it is")


def _shapes(tree: Any) -> str:
    """Return type and shape of an array, or of the arrays of a dictionary, as JAX writes them."""
    if isinstance(tree, dict):
        return ", ".join(f"{name}: {_shapes(value)}" for name, value in tree.items())
    return "nothing" if tree is None else f"{tree.dtype}{list(tree.shape)}"
