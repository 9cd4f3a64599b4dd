"""The engine `jax`: forward dynamics and RK4 over substeps.

It compiles fast, runs 1.1 to 3.3 times as fast as C on a core and agrees with it. The forward
dynamics appear once in the program: RK4 is a scan over its tableau inside the scan over substeps.
"""

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array

from dgae_jax.physics.engine import Physics, PhysicsState, Reads, StepFn, single_env
from dgae_jax.physics.jax import math, solver
from dgae_jax.physics.jax.collision import collision, contact_groups
from dgae_jax.physics.jax.constraint import make_constraint, rne_postconstraint
from dgae_jax.physics.jax.model import put_model
from dgae_jax.physics.jax.smooth import smooth

_RK4_A = (0.0, 0.5, 0.5, 1.0)
_RK4_B = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
_BLOCK = 128  # envs computed together on a CPU, to fit its cache


def jax_engine(spec: mujoco.MjSpec, frame_skip: int, reads: Reads) -> Physics:
    """Build MuJoCo in JAX."""
    model = spec.compile()
    m = put_model(model)
    groups = contact_groups(m, spec.modelname)
    h, free = model.opt.timestep, m.has_free_root

    def forward(qacc_warmstart, qpos, qvel, ctrl):
        """Return `qacc`, and `xpos` and `cfrc_ext` as far as they are read."""
        s = smooth(m, qpos, qvel, ctrl)
        xpos = s.frames[: int(reads.xpos), :, 3]
        cfrc_ext = jnp.zeros((model.nbody if reads.cfrc_ext else 0, 6, qpos.shape[-1]), qpos.dtype)
        if not groups and not model.jnt_limited.any():
            return math.solve(s.qM, s.qfrc_smooth), (xpos, cfrc_ext)
        contacts = collision(groups, s.frames)
        constraint = make_constraint(m, contacts, s, qpos, qvel)
        problem = solver.Problem(s.qM, s.qfrc_smooth, *constraint)
        solution = solver.solve(problem, qacc_warmstart)
        if reads.cfrc_ext:
            efc_force = -constraint.efc_D * jnp.minimum(solution.Jaref, 0)
            cfrc_ext = rne_postconstraint(m, contacts, s.subtree_com, efc_force)
        return solution.qacc, (xpos, cfrc_ext)

    def rungekutta4(state: PhysicsState, ctrl: Array) -> PhysicsState:
        q, v = state.qpos, state.qvel

        def stage(carry, tableau):
            (k_q, k_v), (sum_q, sum_v), _ = carry
            a, b = tableau
            qvel = v + a * h * k_v
            qacc, seen = forward(k_v, _integrate_pos(q, a * h * k_q, free), qvel, ctrl)
            if free:  # as C corrects the rotation of a free joint
                qvel = qvel.at[3:6].set(_dexp_inv(a * h * k_q[3:6], qvel[3:6]))
            return ((qvel, qacc), (sum_q + b * qvel, sum_v + b * qacc), seen), None

        # the first stage is at a = 0: there k_v is only the warm start
        zero = jnp.zeros_like(v)
        carry = (zero, state.qacc_warmstart), (jnp.zeros_like(v), jnp.zeros_like(v)), state[3:]
        tableau = jnp.asarray(_RK4_A, v.dtype), jnp.asarray(_RK4_B, v.dtype)
        ((_, qacc), (dq, dv), seen), _ = jax.lax.scan(stage, carry, tableau)
        return PhysicsState(_integrate_pos(q, h * dq, free), v + h * dv, qacc, *seen)

    @jax.default_matmul_precision("highest")  # TF32 on GPUs is too coarse for dynamics
    def step(state: PhysicsState, ctrl: Array) -> PhysicsState:
        return jax.lax.fori_loop(0, frame_skip, lambda _, state: rungekutta4(state, ctrl), state)

    return Physics(model, single_env(_in_blocks(step)), "jax", reads)


def _in_blocks(step: StepFn) -> StepFn:
    """On a CPU, step the envs in blocks of about the same size, one after the other."""

    def blocks(state: PhysicsState, ctrl: Array) -> PhysicsState:
        envs = ctrl.shape[-1]
        count = -(-envs // _BLOCK)
        size = -(-envs // count)

        def split(x):
            padding = [(0, 0)] * (x.ndim - 1) + [(0, count * size - envs)]
            full = jnp.pad(x, padding, mode="edge")
            return jnp.moveaxis(full.reshape(*x.shape[:-1], count, size), -2, 0)

        def merge(x):
            return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], count * size)[..., :envs]

        out = jax.lax.map(lambda block: step(*block), jax.tree.map(split, (state, ctrl)))
        return jax.tree.map(merge, out)

    def whole_or_blocks(state: PhysicsState, ctrl: Array) -> PhysicsState:
        if ctrl.shape[-1] <= _BLOCK:
            return step(state, ctrl)
        return jax.lax.platform_dependent(state, ctrl, cpu=blocks, default=step)

    return whole_or_blocks


def _integrate_pos(qpos: Array, move: Array, free: bool) -> Array:
    """Return the position after a displacement in velocity coordinates."""
    if not free:
        return qpos + move
    rotated = math.quat_integrate(qpos[3:7], move[3:6])
    return jnp.concatenate([qpos[:3] + move[:3], rotated, qpos[7:] + move[6:]])


def _dexp_inv(theta: Array, omega: Array) -> Array:
    """Rate of a rotation vector θ of a body that turns at ω, to fourth order (Munthe-Kaas 1998)."""
    once = math.cross(theta, omega)
    return omega + 0.5 * once + math.cross(theta, once) / 12
