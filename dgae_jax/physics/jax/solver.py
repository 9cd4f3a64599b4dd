"""Constraint forces: a convex problem in the acceleration, solved by Newton's method.

    minimize over qacc   ½ (qacc − qacc_smooth)ᵀ M (qacc − qacc_smooth) + ½ Σᵢ Dᵢ min(Jarefᵢ, 0)²

with Jaref = J qacc − aref: a row pushes only where it falls short of its reference (pyramidal
cones and limits, without friction loss and equalities). The cost is piecewise quadratic, so
Newton's method ends once the set of active rows no longer changes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dgae_jax.physics.jax import math

ITERATIONS = 20  # measured, the tasks need at most a dozen
LS_ITERATIONS = 8
UNCHECKED = 2  # steps on an accelerator between checks, each a round trip to the host


class Problem(NamedTuple):
    """The problem of N envs; `qfrc_smooth` is M qacc_smooth, the rows are those of `Constraint`."""

    qM: Float[Array, "V V N"]
    qfrc_smooth: Float[Array, "V N"]
    efc_J: Float[Array, "V C N"]
    efc_D: Float[Array, "C N"]
    efc_aref: Float[Array, "C N"]


class Context(NamedTuple):
    """Data updated during each Newton step; `gauss_grad` is M qacc − qfrc_smooth."""

    qacc: Float[Array, "V N"]
    Jaref: Float[Array, "C N"]
    gauss_grad: Float[Array, "V N"]
    done: Bool[Array, " N"]
    niter: Int[Array, " N"]


def solve(p: Problem, qacc_warmstart: Float[Array, "V N"]) -> Context:
    """Find the optimum from a warm start, in at most `ITERATIONS` Newton steps.

    All envs take the first step together. Those that need more take them in groups of a quarter on
    a CPU: a loop over all envs would turn as often as the slowest needs. On an accelerator, where
    envs cost little and turns much, all continue together.
    """

    def pending(ctx: Context) -> Array:
        return ~ctx.done.all()

    def in_groups(p: Problem, ctx: Context) -> Context:
        size = -(-ctx.done.shape[0] // 4)

        def one_group(ctx: Context) -> Context:
            _, envs = jax.lax.top_k(~ctx.done, size)
            problem, part = jax.tree.map(lambda x: x[..., envs], (p, ctx))
            part = jax.lax.while_loop(pending, lambda c: _newton_step(problem, c), part)
            return jax.tree.map(lambda all, part: all.at[..., envs].set(part), ctx, part)

        return jax.lax.while_loop(pending, one_group, ctx)

    def together(p: Problem, ctx: Context) -> Context:
        def steps(ctx: Context) -> Context:
            for _ in range(UNCHECKED):
                ctx = _newton_step(p, ctx)
            return ctx

        return jax.lax.while_loop(pending, steps, ctx)

    Jaref = math.combine(p.efc_J, qacc_warmstart) - p.efc_aref
    gauss_grad = math.combine(p.qM, qacc_warmstart) - p.qfrc_smooth
    none = jnp.zeros(qacc_warmstart.shape[-1:], bool)
    start = Context(qacc_warmstart, Jaref, gauss_grad, none, none.astype(jnp.int32))
    ctx = _newton_step(p, start)
    return jax.lax.platform_dependent(p, ctx, cpu=in_groups, default=together)


def _newton_step(p: Problem, ctx: Context) -> Context:
    D = jnp.where(ctx.Jaref < 0, p.efc_D, 0)
    rows = range(len(D))
    JD = p.efc_J * D
    hessian = p.qM + sum(JD[:, None, c] * p.efc_J[None, :, c] for c in rows)
    grad = ctx.gauss_grad + sum(JD[:, c] * ctx.Jaref[c] for c in rows)
    search = -math.solve(hessian, grad)
    jv, mv = math.combine(p.efc_J, search), math.combine(p.qM, search)
    alpha = _linesearch(p.efc_D, ctx, jv, math.dot(search, ctx.gauss_grad), math.dot(search, mv))
    step = alpha * search
    qacc, Jaref = ctx.qacc + step, ctx.Jaref + alpha * jv
    same_rows = jnp.all((Jaref < 0) == (ctx.Jaref < 0), 0) & (jnp.abs(alpha - 1) < 1e-3)
    smallest = 4 * jnp.finfo(qacc.dtype).eps * jnp.max(jnp.abs(qacc), 0)
    no_progress = jnp.max(jnp.abs(step), 0) <= smallest
    done = same_rows | no_progress | (ctx.niter + 1 >= ITERATIONS)
    new = Context(qacc, Jaref, ctx.gauss_grad + alpha * mv, done, ctx.niter + 1)
    return jax.tree.map(lambda old, new: jnp.where(ctx.done, old, new), ctx, new)


def _linesearch(efc_D: Array, ctx: Context, jv: Array, slope: Array, curvature: Array) -> Array:
    """Minimize the cost along a step: safeguarded Newton on its piecewise linear derivative.

    `jv` is J times the step, `slope` and `curvature` are the derivatives of the first term. On a
    CPU the loop ends with the slowest env that is not done; an accelerator unrolls it.
    """
    linear, quadratic = efc_D * jv * ctx.Jaref, efc_D * jv * jv

    def refine(carry):
        alpha, low, high, _, n = carry
        active = (ctx.Jaref + alpha * jv) < 0
        deriv_0 = slope + jnp.sum(jnp.where(active, linear, 0), 0)
        deriv_1 = curvature + jnp.sum(jnp.where(active, quadratic, 0), 0)
        deriv = deriv_0 + alpha * deriv_1
        low, high = jnp.where(deriv < 0, alpha, low), jnp.where(deriv > 0, alpha, high)
        root = -deriv_0 / deriv_1
        outside = jnp.where(jnp.isfinite(high), 0.5 * (low + high), root)
        return jnp.where((root >= low) & (root <= high), root, outside), low, high, alpha, n + 1

    def moving(carry):
        alpha, _, _, before, n = carry
        return (n < LS_ITERATIONS) & ((jnp.abs(alpha - before) > 1e-6 * alpha) & ~ctx.done).any()

    def loop(carry):
        return jax.lax.while_loop(moving, refine, carry)

    def unrolled(carry):
        for _ in range(LS_ITERATIONS):
            carry = refine(carry)
        return carry

    one = jnp.ones_like(slope)
    start = one, 0 * one, jnp.inf * one, 0 * one, 0
    alpha = jax.lax.platform_dependent(start, cpu=loop, default=unrolled)[0]
    return jnp.where(jnp.isfinite(alpha), alpha, 0)
