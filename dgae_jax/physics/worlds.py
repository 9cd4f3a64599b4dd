"""Many worlds as one axis, however a step is vmapped: an engine sees how many there are while it is traced."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from dgae_jax.physics.engine import PhysicsState

Step = Callable[[PhysicsState, Array], PhysicsState]


def of_one_world(advance: Step) -> Step:
    """A step of one world from one of many, whose last axis is the world."""

    @jax.custom_batching.custom_vmap
    def many(state, ctrl):
        return advance(state, ctrl)

    @many.def_vmap
    def _(size, batched, *args):
        worlds = args[1].shape[-1]

        def merge(x, has):
            x = jnp.moveaxis(x, 0, -2) if has else jnp.repeat(x[..., None, :], size, -2)
            return x.reshape(*x.shape[:-2], size * worlds)

        out = many(*jax.tree.map(merge, args, tuple(batched)))
        return jax.tree.map(
            lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], size, worlds), -2, 0), out
        ), jax.tree.map(lambda _: True, out)

    def step(state: PhysicsState, ctrl: Array) -> PhysicsState:
        return jax.tree.map(
            lambda x: x[..., 0], many(*jax.tree.map(lambda x: x[..., None], (state, ctrl)))
        )

    return step
