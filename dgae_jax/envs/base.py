"""Brax and its contract of an environment. They are imported from here, so that MJX, which Brax imports, is first imported by our
engine of that name, where it cannot print that Warp is not installed.
"""

import dgae_jax.physics.mjx  # noqa: F401, I001
import brax.envs
from brax.envs.base import Env, State, Wrapper

__all__ = ["Env", "State", "Wrapper", "brax"]
