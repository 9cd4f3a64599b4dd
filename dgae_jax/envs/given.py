"""An environment of one's own, given as an object, under our trainer."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from dgae_jax.envs import contract
from dgae_jax.envs.base import Env, State, Wrapper, restart
from dgae_jax.envs.registry import CUSTOM, GIVEN


class Given(Wrapper):
    """Somebody's environment, with what the trainer asks beyond Brax's contract: the range of its actions."""

    @property
    def action_range(self) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
        """The lowest and highest action: its own `action_range`, or −1 and 1."""
        own = getattr(self.env, "action_range", (-1.0, 1.0))
        low, high = (jnp.broadcast_to(jnp.asarray(each, float), self.action_size) for each in own)
        return low, high

    def restart(self, state: State, rng: Array, done: Array) -> State:
        """Its own, where it has one."""
        return restart(self.env, state, rng, done)


def with_range(env: Env) -> Env:
    """The environment, with a range of its actions if it has none."""
    return env if hasattr(env, "action_range") else Given(env)


def make(name: str, physics: str, version: None) -> Env:
    """The object that was given under `name`; raises ValueError, with the reason, for one that the trainer cannot take."""
    env = GIVEN[CUSTOM + name]
    if not isinstance(env, Env):
        raise ValueError(f"{type(env).__name__} is not a brax.envs.base.Env")
    contract.check(env)
    return Given(env)
