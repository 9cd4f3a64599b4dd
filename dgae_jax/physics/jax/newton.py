"""The forces of contacts and joint limits: a convex problem in the acceleration, solved to its optimum by Newton's method.

    minimise over a   ½ (a − a₀)ᵀ M (a − a₀) + ½ Σᵢ Dᵢ min(Jᵢ a − aᵢᵣₑ, 0)²

a₀ is the acceleration without constraints; a row pushes only where Jᵢ a falls short of its reference (MuJoCo's
pyramidal cones and limits, without friction loss and equalities). The cost is piecewise quadratic, so that Newton's
method ends once the set of active rows stands still.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dgae_jax.physics.jax import spatial

ITERATIONS = 20
"""Most Newton steps; measured, the tasks need at most a dozen."""
LINE_SEARCH = 8
"""Most steps of the exact line search on a piecewise quadratic."""
UNCHECKED = 2
"""Newton steps on an accelerator before it asks whether all worlds are done, which costs a round trip to the host."""


class Problem(NamedTuple):
    """The quantities above, for W worlds: V degrees of freedom, C constraint rows."""

    mass: Float[Array, "V V W"]
    """M, MuJoCo's `qM` in full."""
    force: Float[Array, "V W"]
    """M a₀ = `qfrc_smooth`."""
    jacobian: Float[Array, "V C W"]
    """Jᵀ, `efc_J` transposed."""
    stiffness: Float[Array, "C W"]
    """D, `efc_D`; zero for a row that is not active."""
    reference: Float[Array, "C W"]
    """a_ref, `efc_aref`."""


class Solution(NamedTuple):
    """The optimum, and how it was reached."""

    acceleration: Float[Array, "V W"]
    """`qacc`."""
    push: Float[Array, "C W"]
    """`efc_force`, the force along each row."""
    iterations: Int[Array, " W"]
    """`solver_niter`."""


class _Iterate(NamedTuple):
    a: Float[Array, "V W"]
    """`qacc`."""
    r: Float[Array, "C W"]
    """J a − a_ref."""
    g: Float[Array, "V W"]
    """M (a − a₀)."""
    done: Bool[Array, " W"]
    """Whether the world has converged."""
    n: Int[Array, " W"]
    """Newton steps so far."""


def solve(p: Problem, guess: Float[Array, "V W"]) -> Solution:
    """From a guess to the optimum, in at most `ITERATIONS` steps: all worlds take one together, and those that need more go on."""
    r, g = (
        spatial.combine(p.jacobian, guess) - p.reference,
        spatial.combine(p.mass, guess) - p.force,
    )
    none = jnp.zeros(guess.shape[-1:], bool)
    state = _newton(p, _Iterate(guess, r, g, none, none.astype(jnp.int32)))
    state = jax.lax.platform_dependent(p, state, cpu=_finish_in_groups, default=_finish_together)
    return Solution(state.a, -p.stiffness * jnp.minimum(state.r, 0), state.n)


def _finish_in_groups(p: Problem, state: _Iterate) -> _Iterate:
    """In groups of a quarter, until no world is left: a loop over all of them would turn as often as its slowest world needs."""
    group = -(-state.done.shape[0] // 4)

    def finish_some(state: _Iterate) -> _Iterate:
        _, some = jax.lax.top_k(~state.done, group)
        problem, part = jax.tree.map(lambda x: x[..., some], (p, state))
        part = jax.lax.while_loop(lambda s: ~s.done.all(), lambda s: _newton(problem, s), part)
        return jax.tree.map(lambda all, part: all.at[..., some].set(part), state, part)

    return jax.lax.while_loop(lambda s: ~s.done.all(), finish_some, state)


def _finish_together(p: Problem, state: _Iterate) -> _Iterate:
    """All worlds at once, `UNCHECKED` steps at a time: on an accelerator, where worlds cost little and turns much."""

    def some(state: _Iterate) -> _Iterate:
        for _ in range(UNCHECKED):
            state = _newton(p, state)
        return state

    return jax.lax.while_loop(lambda s: ~s.done.all(), some, state)


def _newton(p: Problem, s: _Iterate) -> _Iterate:
    weight = jnp.where(s.r < 0, p.stiffness, 0)
    rows = range(len(weight))
    weighted = p.jacobian * weight
    hessian = p.mass + sum(weighted[:, None, c] * p.jacobian[None, :, c] for c in rows)
    step = -spatial.solve(hessian, s.g + sum(weighted[:, c] * s.r[c] for c in rows))
    moves, push = spatial.combine(p.jacobian, step), spatial.combine(p.mass, step)
    slope, curvature = spatial.dot(step, s.g), spatial.dot(step, push)
    length = _line_search(slope, curvature, p.stiffness, s.r, moves, s.done)
    a, r, g = s.a + length * step, s.r + length * moves, s.g + length * push
    stands = jnp.all((r < 0) == (s.r < 0), 0) & (jnp.abs(length - 1) < 1e-3)
    tiny = jnp.max(jnp.abs(length * step), 0) <= 4 * jnp.finfo(a.dtype).eps * jnp.max(jnp.abs(a), 0)
    new = _Iterate(a, r, g, stands | tiny | (s.n + 1 >= ITERATIONS), s.n + 1)
    return jax.tree.map(lambda old, new: jnp.where(s.done, old, new), s, new)


def _line_search(
    slope0: Array, curvature: Array, stiffness: Array, r: Array, moves: Array, done: Array
) -> Array:
    """The length that minimises the cost along a step: safeguarded Newton on its piecewise linear derivative.

    Nobody waits for worlds that are `done`, whose step is not taken. An accelerator takes all steps and asks for no result.
    """
    linear, quadratic = stiffness * moves * r, stiffness * moves * moves

    def refine(carry):
        length, low, high, _, n = carry
        active = (r + length * moves) < 0
        intercept = slope0 + jnp.sum(jnp.where(active, linear, 0), 0)
        gradient = curvature + jnp.sum(jnp.where(active, quadratic, 0), 0)
        slope = intercept + length * gradient
        low, high = jnp.where(slope < 0, length, low), jnp.where(slope > 0, length, high)
        root = -intercept / gradient
        outside = jnp.where(jnp.isfinite(high), 0.5 * (low + high), root)
        new = jnp.where((root >= low) & (root <= high), root, outside)
        return new, low, high, length, n + 1

    def moving(carry):
        length, _, _, before, n = carry
        return (n < LINE_SEARCH) & ((jnp.abs(length - before) > 1e-6 * length) & ~done).any()

    def written_out(carry):
        for _ in range(LINE_SEARCH):
            carry = refine(carry)
        return carry

    one = jnp.ones_like(slope0)
    start = one, 0 * one, jnp.inf * one, 0 * one, 0
    length = jax.lax.platform_dependent(
        start, cpu=lambda carry: jax.lax.while_loop(moving, refine, carry), default=written_out
    )[0]
    return jnp.where(jnp.isfinite(length), length, 0)
