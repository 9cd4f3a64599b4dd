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

ITERATIONS = 20
"""Most Newton steps; measured, the tasks need at most a dozen."""
LINE_SEARCH = 8
"""Steps of the exact line search on a piecewise quadratic."""


class Problem(NamedTuple):
    """The quantities above, for one world: V degrees of freedom, C constraint rows."""

    mass: Float[Array, "V V"]
    smooth: Float[Array, " V"]
    """a₀."""
    force: Float[Array, " V"]
    """M a₀."""
    jacobian_t: Float[Array, "V C"]
    """Jᵀ: with the rows along the last axis JᵀDJ takes half the time on a CPU."""
    stiffness: Float[Array, " C"]
    """D, the inverse of the regularisation."""
    reference: Float[Array, " C"]


class Solution(NamedTuple):
    """The optimum, and how it was reached."""

    acceleration: Float[Array, " V"]
    residual: Float[Array, " C"]
    """J a − a_ref; rows below zero are active and push with −D times it."""
    iterations: Int[Array, ""]


def _cost(p: Problem, a: Array, r: Array) -> Array:
    return 0.5 * jnp.dot(a - p.smooth, p.mass @ a - p.force) + 0.5 * jnp.sum(p.stiffness * jnp.minimum(r, 0) ** 2)


class _Iterate(NamedTuple):
    a: Float[Array, " V"]
    r: Float[Array, " C"]
    done: Bool[Array, ""]
    n: Int[Array, ""]


@jax.custom_batching.custom_vmap
def solve(p: Problem, guess: Float[Array, " V"]) -> Solution:
    """From the better of `guess` and a₀ to the optimum, in at most `ITERATIONS` steps."""
    return _solution(_finish(p, _start(p, guess)))


@solve.def_vmap
def _solve_many(size: int, batched, p: Problem, guess: Array) -> tuple[Solution, Solution]:
    """All worlds take two steps together; those that need more go on in groups, until no world is left.

    A loop over all of them would turn as often as its slowest world needs.
    """
    p, guess = jax.tree.map(lambda x, has: x if has else jnp.broadcast_to(x, (size, *x.shape)), (p, guess), tuple(batched))
    state = jax.vmap(_start)(p, guess)
    for _ in range(2):
        state = jax.vmap(_continue)(p, state)
    group = min(size, max(16, size // 8))

    def finish_some(state: _Iterate) -> _Iterate:
        _, worlds = jax.lax.top_k(~state.done, group)
        some = jax.vmap(_finish)(*jax.tree.map(lambda x: x[worlds], (p, state)))
        return jax.tree.map(lambda all, part: all.at[worlds].set(part), state, some)

    state = jax.lax.while_loop(lambda s: ~s.done.all(), finish_some, state)
    solution = jax.vmap(_solution)(state)
    return solution, jax.tree.map(lambda _: True, solution)


def _start(p: Problem, guess: Array) -> _Iterate:
    r_guess, r_smooth = guess @ p.jacobian_t - p.reference, p.smooth @ p.jacobian_t - p.reference
    warm = _cost(p, guess, r_guess) < _cost(p, p.smooth, r_smooth)
    return _Iterate(jnp.where(warm, guess, p.smooth), jnp.where(warm, r_guess, r_smooth), jnp.array(False), jnp.int32(0))


def _newton(p: Problem, s: _Iterate) -> _Iterate:
    weight = jnp.where(s.r < 0, p.stiffness, 0)
    residual = p.mass @ s.a - p.force
    hessian = p.mass + (p.jacobian_t * weight) @ p.jacobian_t.T
    step = -_solve_spd(hessian, residual + p.jacobian_t @ (weight * s.r))
    moves = step @ p.jacobian_t
    length = _line_search(jnp.dot(step, residual), jnp.dot(step, p.mass @ step), p.stiffness, s.r, moves)
    a, r = s.a + length * step, s.r + length * moves
    stands = jnp.all((r < 0) == (s.r < 0)) & (jnp.abs(length - 1) < 1e-3)
    tiny = jnp.max(jnp.abs(length * step)) <= 4 * jnp.finfo(a.dtype).eps * jnp.max(jnp.abs(a))
    return _Iterate(a, r, stands | tiny | (s.n + 1 >= ITERATIONS), s.n + 1)


def _continue(p: Problem, s: _Iterate) -> _Iterate:
    return jax.tree.map(lambda old, new: jnp.where(s.done, old, new), s, _newton(p, s))


def _finish(p: Problem, s: _Iterate) -> _Iterate:
    return jax.lax.while_loop(lambda s: ~s.done, lambda s: _newton(p, s), s)


def _solution(s: _Iterate) -> Solution:
    return Solution(s.a, s.r, s.n)


def _solve_spd(matrix: Float[Array, "V V"], vector: Float[Array, " V"]) -> Float[Array, " V"]:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), vector)


def _line_search(slope0: Array, curvature: Array, stiffness: Array, r: Array, moves: Array) -> Array:
    """The length that minimises the cost along a step: safeguarded Newton on its piecewise linear derivative."""
    linear, quadratic = stiffness * moves * r, stiffness * moves * moves

    def refine(carry, _):
        length, low, high = carry
        active = (r + length * moves) < 0
        intercept, gradient = slope0 + jnp.sum(linear * active), curvature + jnp.sum(quadratic * active)
        slope = intercept + length * gradient
        low, high = jnp.where(slope < 0, length, low), jnp.where(slope > 0, length, high)
        root = -intercept / gradient
        outside = jnp.where(jnp.isfinite(high), 0.5 * (low + high), root)
        return (jnp.where((root >= low) & (root <= high), root, outside), low, high), None

    one = jnp.ones_like(slope0)
    (length, _, _), _ = jax.lax.scan(refine, (one, 0 * one, jnp.inf * one), None, length=LINE_SEARCH, unroll=LINE_SEARCH)
    return jnp.where(jnp.isfinite(length), length, 0)
