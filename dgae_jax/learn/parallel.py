"""Compiled programs of a run: many iterations per dispatch, many seeds at once."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import ArrayLike

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.base import Env
from dgae_jax.learn import devices
from dgae_jax.learn.build import make_algorithm
from dgae_jax.learn.iteration import InitFn, TrainStep, make_train
from dgae_jax.learn.types import Metrics, TrainState


class Trainer(NamedTuple):
    """The compiled programs of a run; every leaf of the state has a leading axis of S seeds."""

    init: Callable[[ResolvedConfig, jax.Array], TrainState]
    """`init(config, keys [S]) -> state`."""
    dispatch: Callable[[ResolvedConfig, TrainState, int], tuple[TrainState, Metrics]]
    """`dispatch(config, state, count) -> (state, metrics [capacity, S])`: `count <= capacity`
    iterations; rows from `count` on are zero. The buffers of the input state are donated."""


COMPILER_OPTIONS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""XLA would divide single operations between CPU threads, which costs more than they take."""


def make_trainer(env: Env, capacity: int, mesh: Mesh | None = None) -> Trainer:
    """Compile once, run any number of iterations per call.

    Args:
        env: the task.
        capacity: most iterations in one dispatch.
        mesh: the devices that share the work (`devices.make_mesh`); by default there is one.

    Returns:
        Programs; the traced leaves of their configurations may change between calls.
    """

    def functions(config: ResolvedConfig) -> tuple[InitFn, TrainStep]:
        return make_train(make_algorithm(config.algo, env, config), env, config)

    @partial(jax.jit, compiler_options=COMPILER_OPTIONS)
    @devices.shared_by(mesh)
    def init(config: ResolvedConfig, keys: jax.Array) -> TrainState:
        # one seed after the other: weights need QR decompositions, and XLA's CPU code for several
        # of them at once may wait for threads that wait for it (two seeds of 64 envs hang)
        return over_seeds(functions(config)[0], lambda f: partial(jax.lax.map, f))(keys)

    @partial(jax.jit, donate_argnums=1, compiler_options=COMPILER_OPTIONS)
    @devices.shared_by(mesh)
    def dispatch(config: ResolvedConfig, state: TrainState, count: ArrayLike):
        step = jax.jit(over_seeds(functions(config)[1]))  # jitted, to be traced once
        shapes = jax.eval_shape(step, state)[1]
        rows = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), shapes)

        def iteration(i, carry):
            state, rows = carry
            state, row = step(state)
            return state, jax.tree.map(lambda all, one: all.at[i].set(one), rows, row)

        return jax.lax.fori_loop(0, count, iteration, (state, rows))

    return Trainer(init, dispatch)


def over_seeds(f: Callable, many: Callable[[Callable], Callable] = jax.vmap) -> Callable:
    """Map `f` over the leading axis of its argument, divided between devices where it is even.

    An axis of one is removed and put back: XLA's CPU code for a leading 1 is several times slower.
    """

    def mapped(tree: Any) -> Any:
        if len(jax.tree.leaves(tree)[0]) > 1:
            return many(f)(tree)
        return jax.tree.map(lambda x: jnp.expand_dims(x, 0), f(jax.tree.map(lambda x: x[0], tree)))

    def shared(tree: Any) -> Any:
        even = len(jax.tree.leaves(tree)[0]) % devices.count() == 0
        return (devices.divided(mapped, (0,), 0) if even else mapped)(tree)

    return shared
