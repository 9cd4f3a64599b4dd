"""Brax's contract of an environment.

Brax is imported from here, after our MJX engine: whoever imports MJX first sees it print that Warp
is not installed, which the engine suppresses.
"""

import dgae_jax.physics.mjx  # noqa: F401, I001
import brax.envs
from brax.envs.base import Env, State, Wrapper
from jaxtyping import Array, Float

__all__ = ["Env", "State", "ThirdPartyEnv", "Wrapper", "brax", "restart"]


class ThirdPartyEnv(Env):
    """An env with sizes and a range of actions that are known when it is built."""

    observation_size: int = 0  # pyright: ignore
    action_size: int = 0  # pyright: ignore
    backend: str = ""  # pyright: ignore
    action_range: tuple[Float[Array, " A"], Float[Array, " A"]]


def restart(env: Env, state: State, rng: Array, done: Array) -> State:
    """Reset an env; callers use the result only where `done`.

    By default this is `env.reset(rng)`, computed in every env at every step. The class of `env` may
    define a method `restart(state, rng, done)`, which may return anything elsewhere.
    """
    own = getattr(type(env), "restart", None)  # of the class: a wrapper passes on attributes
    return env.reset(rng) if own is None else own(env, state, rng, done)
