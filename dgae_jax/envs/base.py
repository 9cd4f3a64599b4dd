"""Brax and its contract of an environment. They are imported from here, so that MJX, which Brax imports, is first imported by our
engine of that name, where it cannot print that Warp is not installed.
"""

import dgae_jax.physics.mjx  # noqa: F401, I001
import brax.envs
import jax
from brax.envs.base import Env, State, Wrapper
from jaxtyping import Array

__all__ = ["Env", "State", "Wrapper", "brax", "has_limit", "restart"]


def restart(env: Env, state: State, rng: Array, done: Array) -> State:
    """A fresh episode for a world that is in `state`, looked at only where that one is `done`.

    It is `env.reset(rng)`, computed in every world at every step, unless the class of `env` has a method
    `restart(state, rng, done)` of its own, which may return anything of that shape for a world that is not done.
    """
    own = getattr(
        type(env), "restart", None
    )  # a wrapper passes on what its environment has, which is not its own
    return env.reset(rng) if own is None else own(env, state, rng, done)


def has_limit(env: Env) -> bool:
    """Whether the task may cut an episode short itself, which it says by `truncation` in `info`, as Brax has it."""
    return "truncation" in jax.eval_shape(env.reset, jax.random.key(0)).info
