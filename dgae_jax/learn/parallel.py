"""Many iterations per dispatch, many runs side by side: the compiled programs of a run."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import ArrayLike

from dgae_jax.learn import devices
from dgae_jax.learn.iteration import Metrics
from dgae_jax.learn.types import TrainState


class Trainer(NamedTuple):
    """The compiled programs of a run, over all its seeds at once; every leaf of the state has a leading seed axis."""

    init: Callable[[Any, jax.Array], TrainState]
    """`init(config, keys [S]) -> state`."""
    dispatch: Callable[[Any, TrainState, int], tuple[TrainState, Metrics]]
    """`dispatch(config, state, count) -> (state, metrics [capacity, S])`: `count <= capacity` iterations; rows from
    `count` on are zero. The buffers of the input state are donated."""


COMPILER_OPTIONS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""On a CPU XLA would divide single operations between threads, which costs more than operations of this size take."""


def make_trainer(make_train: Callable[[Any], tuple[Callable, Callable]], capacity: int, mesh: Mesh | None = None) -> Trainer:
    """Compile once, run any number of iterations per call; traced leaves of the configuration may change between calls.

    `make_train(config) -> (init(key) -> state, train_step(state) -> (state, metrics))`; the devices of `mesh` share the work.
    """

    @partial(jax.jit, compiler_options=COMPILER_OPTIONS)
    @devices.shared_by(mesh)
    def init(config: Any, keys: jax.Array) -> TrainState:
        return over_seeds(make_train(config)[0], in_turn)(keys)

    @partial(jax.jit, donate_argnums=1, compiler_options=COMPILER_OPTIONS)
    @devices.shared_by(mesh)
    def dispatch(config: Any, state: TrainState, count: ArrayLike):
        step = jax.jit(over_seeds(make_train(config)[1]))  # jitted, so that asking for its shapes does not trace it twice
        rows = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), jax.eval_shape(step, state)[1])

        def iteration(i, carry):
            state, rows = carry
            state, row = step(state)
            return state, jax.tree.map(lambda all, one: all.at[i].set(one), rows, row)

        return jax.lax.fori_loop(0, count, iteration, (state, rows))

    return Trainer(init, dispatch)


def in_turn(f: Callable) -> Callable:
    """`f` for one after the other.

    The first weights need QR decompositions, and XLA's CPU code for many of them side by side may wait for threads that wait for it
    (seen: two seeds of 64 worlds on two cores hang).
    """
    return partial(jax.lax.map, f)


def over_seeds(f: Callable, many: Callable[[Callable], Callable] = jax.vmap) -> Callable:
    """`f` mapped by `many` over the leading axis of its argument, which is divided between devices where that comes out even.

    An axis of one is taken off and put back: XLA's CPU code for arrays with a leading 1 is several times slower.
    """

    def mapped(tree: Any) -> Any:
        if _seeds(tree) > 1:
            return many(f)(tree)
        return jax.tree.map(lambda x: jnp.expand_dims(x, 0), f(jax.tree.map(lambda x: x[0], tree)))

    def shared(tree: Any) -> Any:
        return (devices.divided(mapped, (0,), 0) if _seeds(tree) % devices.count() == 0 else mapped)(tree)

    return shared


def _seeds(tree: Any) -> int:
    return jax.tree.leaves(tree)[0].shape[0]
