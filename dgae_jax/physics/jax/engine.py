"""MuJoCo in JAX, stepped so that it compiles fast, runs about as fast as C on a core and agrees with it.

- The world is the last axis of every array, so that all arithmetic runs along it; the stages of MuJoCo's forward dynamics
  (`dynamics`, `contacts`, `newton`) are written for that, and each agrees with C's.
- The forward dynamics appear once in the program: RK4 is a scan over its tableau inside the scan over substeps.
- The rotation of a free joint is integrated with RKMK's correction from MuJoCo 4 on, as C does.
"""

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array

from dgae_jax.physics.engine import Physics, PhysicsState, Reads, body_ids
from dgae_jax.physics.jax import contacts, dynamics, newton, spatial
from dgae_jax.physics.jax.coverage import refuse_uncovered
from dgae_jax.physics.jax.scene import known_bound, scene_of
from dgae_jax.physics.worlds import of_one_world

_STAGE = (0.0, 0.5, 0.5, 1.0)
_WEIGHT = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
_BLOCK = 128
"""Worlds computed together on a CPU, so that what they need fits its cache."""
_CORRECTS_ROTATION = int(mujoco.__version__.split(".")[0]) >= 4


def jax_engine(
    spec: mujoco.MjSpec, frame_skip: int, reads: Reads, *, max_contacts: int | None = None
) -> Physics:
    """MuJoCo in JAX, advancing one world; vmap it. Raises ValueError, naming the reason, for a model it does not cover.

    `max_contacts` bounds the contacts with the ground, of which the nearest are kept; by default it is the bound that is
    known for the model (`scene.known_bound`), or all that are possible.
    """
    model = spec.compile()
    refuse_uncovered(model)
    tree = dynamics.tree_of(model)
    scene = scene_of(
        tree, known_bound(spec.modelname, model) if max_contacts is None else max_contacts
    )
    h, free, torsos = (
        model.opt.timestep,
        tree.floating,
        len(body_ids(model, reads)),
    )  # of one tree only the root can float

    def forward(guess, qpos, qvel, ctrl):
        """`qacc`, and `xpos` and `cfrc_ext` as far as they are read."""
        s = dynamics.smooth(tree, qpos, qvel, ctrl)
        xpos = jnp.repeat(s.frames[:1, :, 3], torsos, 0)
        cfrc_ext = jnp.zeros((model.nbody if reads.forces else 0, 6, qpos.shape[-1]), qpos.dtype)
        if not len(scene.limited) and not scene.groups:
            return spatial.solve(s.mass, s.force), (xpos, cfrc_ext)
        rows, met = contacts.constrain(scene, tree, s, qpos, qvel)
        solution = newton.solve(newton.Problem(s.mass, s.force, *rows), guess)
        if reads.forces:
            cfrc_ext = contacts.contact_forces(scene, model, met, s.centre, solution.push)
        return solution.acceleration, (xpos, cfrc_ext)

    def substep(state: PhysicsState, ctrl: Array) -> PhysicsState:
        q, v = state.qpos, state.qvel

        def stage(carry, tableau):
            (k_q, k_v), (sum_q, sum_v), _ = carry
            a, b = tableau
            rate = v + a * h * k_v
            acceleration, seen = forward(k_v, _integrate(q, a * h * k_q, free), rate, ctrl)
            if free and _CORRECTS_ROTATION:
                rate = rate.at[3:6].set(_inverse_exponential(a * h * k_q[3:6], rate[3:6]))
            return ((rate, acceleration), (sum_q + b * rate, sum_v + b * acceleration), seen), None

        # the first stage is at a = 0, so the accelerations before it only start the solver
        first, zero = (
            (jnp.zeros_like(v), state.qacc_warmstart),
            (jnp.zeros_like(v), jnp.zeros_like(v)),
        )
        tableau = jnp.asarray(_STAGE, v.dtype), jnp.asarray(_WEIGHT, v.dtype)
        ((_, warmstart), (dq, dv), seen), _ = jax.lax.scan(
            stage, (first, zero, (state.xpos, state.cfrc_ext)), tableau
        )
        return PhysicsState(_integrate(q, h * dq, free), v + h * dv, warmstart, *seen)

    @jax.default_matmul_precision("highest")  # TF32 on GPUs is no physics
    def advance(state: PhysicsState, ctrl: Array) -> PhysicsState:
        return jax.lax.scan(lambda s, _: (substep(s, ctrl), None), state, None, length=frame_skip)[
            0
        ]

    return Physics(model, of_one_world(_in_blocks(advance)), "jax", reads)


def _in_blocks(advance):
    """On a CPU, worlds in blocks of about the same size, one after the other."""

    def blocks(state: PhysicsState, ctrl: Array) -> PhysicsState:
        worlds = ctrl.shape[-1]
        count = -(-worlds // _BLOCK)
        size = -(-worlds // count)

        def split(x):
            full = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, count * size - worlds)], mode="edge")
            return jnp.moveaxis(full.reshape(*x.shape[:-1], count, size), -2, 0)

        out = jax.lax.map(lambda block: advance(*block), jax.tree.map(split, (state, ctrl)))
        return jax.tree.map(
            lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], count * size)[..., :worlds],
            out,
        )

    def whole_or_blocks(state: PhysicsState, ctrl: Array) -> PhysicsState:
        if ctrl.shape[-1] <= _BLOCK:
            return advance(state, ctrl)
        return jax.lax.platform_dependent(state, ctrl, cpu=blocks, default=advance)

    return whole_or_blocks


def _integrate(qpos: Array, move: Array, free: bool) -> Array:
    """The position after a displacement in velocity coordinates."""
    if not free:
        return qpos + move
    return jnp.concatenate(
        [qpos[:3] + move[:3], spatial.rotate(qpos[3:7], move[3:6]), qpos[7:] + move[6:]]
    )


def _inverse_exponential(theta: Array, omega: Array) -> Array:
    """dexp⁻¹: the rate of a rotation vector θ while the body turns at ω, to fourth order (Munthe-Kaas 1998)."""
    once = spatial.cross(theta, omega)
    return omega + 0.5 * once + spatial.cross(theta, once) / 12
