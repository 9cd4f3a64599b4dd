"""What the trainer takes for an environment, checked on shapes before anything is compiled."""

from typing import Any

import jax
import jax.numpy as jnp

from dgae_jax.envs.base import Env


def check(env: Env) -> None:
    """Raise ValueError, with a reason in one line, for an environment whose reset or step is not as `brax.envs.base.Env` has it.

    Observations must be one array with one axis, rewards and `done` numbers, and a step must give back a state as it got it.
    """
    action = jax.ShapeDtypeStruct((_size(env, "action_size"),), jnp.zeros(()).dtype)
    before = _traced("reset", env.reset, jax.random.key(0))
    after = _traced("step", env.step, before, action)
    for state, where in ((before, "reset"), (after, "step")):
        if getattr(state.obs, "shape", None) != (_size(env, "observation_size"),):
            raise ValueError(
                f"the observation of its {where} has shape {_shapes(state.obs)}, and must be one array [observation_size]"
            )
        for name in ("reward", "done"):
            value = getattr(state, name)
            if getattr(value, "shape", None) != () or not jnp.issubdtype(value.dtype, jnp.floating):
                raise ValueError(
                    f"the {name} of its {where} is {value}, and must be a single real number"
                )
    _same(before, after)


def _size(env: Env, name: str) -> int:
    size = getattr(env, name)
    if not isinstance(size, int):
        raise ValueError(f"its {name} is {size!r}, and must be a whole number")
    return size


def _traced(name: str, function: Any, *arguments: Any) -> Any:
    try:
        return jax.eval_shape(function, *arguments)
    except Exception as reason:  # the code is somebody else's
        why = str(reason).partition("\n")[0]
        raise ValueError(
            f"its {name} cannot be compiled by JAX ({type(reason).__name__}: {why})"
        ) from reason


def _same(before: Any, after: Any) -> None:
    leaves, others = (
        dict(jax.tree_util.tree_flatten_with_path(state)[0]) for state in (before, after)
    )
    for path in leaves | others:
        one, two = (_shapes(each.get(path)) for each in (leaves, others))
        if one != two:
            raise ValueError(
                f"its step turns state{jax.tree_util.keystr(path)} from {one} into {two}, and must leave it as it is"
            )


def _shapes(tree: Any) -> str:
    """Type and shape of an array as JAX writes them, those of a dictionary's arrays, or that there is nothing."""
    if isinstance(tree, dict):
        return ", ".join(f"{name}: {_shapes(value)}" for name, value in tree.items())
    return "nothing" if tree is None else f"{tree.dtype}{list(tree.shape)}"
