"""Sequential loop iterations of an environment step and of an update.

    python benchmarks/turns.py

On an accelerator each iteration costs the launch of its kernels, and one of a data-dependent
`while` loop a round trip to the host besides. The programs are those for accelerators, run here:
iterations are counted by carrying a counter through every loop of the traced program. Envs begin in
random poses and act at random.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import dgae_jax as dg
from dgae_jax.configs.resolved import resolve
from dgae_jax.envs.registry import TASKS
from dgae_jax.learn.types import Batch, TrainableState

CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "checkpoint": "jaxpr",
    "custom_vmap_call": "call",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}
"""Primitives that only call a program, and the parameter that holds it."""


@dataclass(frozen=True)
class Arguments:
    """Size of the measurement."""

    num_envs: int = 2048
    """Parallel envs [envs]."""
    steps: int = 10
    """Environment steps, of which the mean is printed [steps]."""


class Counts(NamedTuple):
    """Sequential loop iterations of a program, and its flops."""

    known: Any
    """Iterations of loops of known length."""
    asked: Any
    """Iterations of `while` loops."""
    flops: Any
    """Floating-point operations of matrix products, 2 per multiplication."""


NONE = Counts(np.float32(0), np.float32(0), np.float32(0))


def counted(f: Callable, platform: str | None = None) -> Callable:
    """Return `g(*args) -> (f(*args), Counts)` on a platform, by default an accelerator."""

    def count(*args: Any) -> tuple[Any, Counts]:
        program, shape = jax.make_jaxpr(f, return_shape=True)(*args)
        out, counts = _run(program, jax.tree.leaves(args), platform)
        return jax.tree.unflatten(jax.tree.structure(shape), out), counts

    return jax.jit(count)


def _run(program: Any, args: list, platform: str | None) -> tuple[list, Counts]:
    """Return the program's outputs and counts."""
    jaxpr, consts = (program.jaxpr, program.consts) if hasattr(program, "consts") else (program, [])
    values, counts = (
        dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True)),
        NONE,
    )
    for eqn in jaxpr.eqns:
        out, more = _evaluate(
            eqn, [x.val if hasattr(x, "val") else values[x] for x in eqn.invars], platform
        )
        values.update(zip(eqn.outvars, out, strict=True))
        counts = _add(counts, more)
    return [x.val if hasattr(x, "val") else values[x] for x in jaxpr.outvars], counts


def _evaluate(eqn: Any, args: list, platform: str | None) -> tuple[list, Counts]:
    """Return one operation's outputs and counts."""
    name, how = eqn.primitive.name, eqn.params
    if name == "platform_index":
        chosen = [i for i, names in enumerate(how["platforms"]) if names and platform in names]
        return [chosen[0] if chosen else how["platforms"].index(None)], NONE
    if name == "custom_linear_solve":  # conjugate gradient
        lengths = how["const_lengths"]
        before = lengths.matvec + lengths.vecmat
        return _run(
            how["jaxprs"].solve,
            args[before : before + lengths.solve] + args[sum(lengths) :],
            platform,
        )
    if name in CALLS:
        return _run(how[CALLS[name]], args, platform)
    if name == "cond":
        return jax.lax.switch(
            args[0], [lambda *x, b=b: _run(b, [*x], platform) for b in how["branches"]], *args[1:]
        )
    if name == "scan":
        fixed, carry, xs = _split(args, how["num_consts"], how["num_carry"])

        def turn(state, x):
            out, more = _run(how["jaxpr"], [*fixed, *state[0], *x], platform)
            return (out[: len(carry)], _add(state[1], more)), out[len(carry) :]

        (carry, counts), ys = jax.lax.scan(
            turn, (carry, NONE), xs, length=how["length"], reverse=how["reverse"]
        )
        return [*carry, *ys], counts._replace(
            known=counts.known + -(-how["length"] // how["unroll"])
        )
    if name == "while":
        asked, fixed, carry = _split(args, how["cond_nconsts"], how["body_nconsts"])

        def repeat(state):
            out, more = _run(how["body_jaxpr"], [*fixed, *state[0]], platform)
            return out, _add(state[1], more)._replace(asked=state[1].asked + more.asked + 1)

        return jax.lax.while_loop(
            lambda s: _run(how["cond_jaxpr"], [*asked, *s[0]], platform)[0][0],
            repeat,
            (carry, NONE),
        )
    out = eqn.primitive.bind(*args, **how)
    return out if eqn.primitive.multiple_results else [out], NONE._replace(
        flops=jnp.float32(_flops(eqn))
    )


def _flops(eqn: Any) -> int:
    if eqn.primitive.name != "dot_general":
        return 0
    (contracted, _), _ = eqn.params["dimension_numbers"]
    return (
        2
        * math.prod(eqn.outvars[0].aval.shape)
        * math.prod(eqn.invars[0].aval.shape[i] for i in contracted)
    )


def _split(items: list, *sizes: int) -> tuple[list, ...]:
    """Split into the first, the next and the rest."""
    a, b = sizes
    return items[:a], items[a : a + b], items[a + b :]


def _add(a: Counts, b: Counts) -> Counts:
    return jax.tree.map(jnp.add, a, b)


def of_step(name: str, num_envs: int, steps: int) -> list[float]:
    """Return the mean iterations of one environment step of all envs."""
    env: Any = dg.make_env(name, physics="jax")
    low, high = env.action_range
    step, key, total = counted(jax.vmap(env.step)), jax.random.key(0), NONE
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, num_envs))
    for k in jax.random.split(key, steps):
        action = jax.random.uniform(k, (num_envs, env.action_size), minval=low, maxval=high)
        state, counts = step(state, action)
        total = _add(total, counts)
    return [float(total.known) / steps, float(total.asked) / steps]


def of_update(algo: str) -> list[list[int]]:
    """Return the iterations of both updates, with the tuned preset of Hopper."""
    config = resolve(dg.preset("tuned", algo, "hopper"))
    env = dg.make_env("hopper", physics="jax")
    algorithm = dg.make_algorithm(algo, env, config)
    size, key = config.samples_per_iteration, jax.random.key(0)
    obs_size = int(env.observation_size)  # pyright: ignore[reportArgumentType]
    obs, next_obs = jax.random.normal(key, (2, size, obs_size))
    action, row = jax.random.normal(key, (size, env.action_size)), jax.random.normal(key, (size,))
    quantiles = algorithm.critic.predict(algorithm.critic.init(key), obs)
    log_prob = jnp.zeros(size) - env.action_size
    batch = Batch(
        obs, action, log_prob, row, row, quantiles, row, row, next_obs, jnp.ones(size, bool)
    )
    found = []
    for network, update in (
        (algorithm.policy, algorithm.policy_update),
        (algorithm.critic, algorithm.critic_update),
    ):
        params = network.init(key)
        _, counts = counted(partial(update.step, key))(
            TrainableState(params, update.init(params)), batch
        )
        found.append([int(counts.known), int(counts.asked)])
    return found


def main() -> None:
    """Print both tables, in Markdown."""
    arguments = tyro.cli(Arguments, description="Loop iterations of a step and of an update.")
    step = f"one environment step of {arguments.num_envs:,} envs, `jax`"
    print(f"| {step} | known length | `while` | together |\n|---|---|---|---|")
    for name in TASKS:
        known, other = of_step(name, arguments.num_envs, arguments.steps)
        print(f"| {name} | {known:,.0f} | {other:,.0f} | {known + other:,.0f} |", flush=True)
    columns = "policy: known length | `while` | critic: known length | `while`"
    print(f"\n| one update, Hopper's preset | {columns} |\n|---|---|---|---|---|")
    for algo in ("ppo", "dppo", "trpo", "dtrpo", "a2c", "da2c"):
        policy, critic = of_update(algo)
        print(
            f"| {algo} | {policy[0]:,} | {policy[1]:,} | {critic[0]:,} | {critic[1]:,} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
