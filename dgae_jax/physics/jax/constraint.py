"""Constraint rows of joint limits and contacts, and the forces that they exert.

Soft constraints with pyramidal friction cones: a row asks for J qacc ≥ aref, up to its
regularization R = 1/D. D is zero for a row that is not active (distance ≥ margin).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from dgae_jax.physics.jax.collision import Contact, as_arrays
from dgae_jax.physics.jax.math import combine, constant, cross, dot
from dgae_jax.physics.jax.model import Model, SolverParams
from dgae_jax.physics.jax.smooth import Smooth


class Constraint(NamedTuple):
    """C constraint rows of N envs; `efc_J` is transposed."""

    efc_J: Float[Array, "V C N"]
    efc_D: Float[Array, "C N"]
    efc_aref: Float[Array, "C N"]


def make_constraint(
    m: Model, contacts: list[Contact], smooth: Smooth, qpos: Array, qvel: Array
) -> Constraint:
    """Compute the rows of all limits, then of all contacts."""
    rows = [_limit_rows(m, qpos, qvel)] if m.mj.jnt_limited.any() else []
    rows += [_contact_rows(contact, smooth, qvel) for contact in contacts]
    efc_J, efc_D, efc_aref = zip(*rows, strict=True)
    return Constraint(jnp.concatenate(efc_J, 1), jnp.concatenate(efc_D), jnp.concatenate(efc_aref))


def _limit_rows(m: Model, qpos: Array, qvel: Array) -> Constraint:
    mj, joints, dtype = m.mj, np.flatnonzero(m.mj.jnt_limited), qpos.dtype
    dofs = mj.jnt_dofadr[joints]
    low, high = (constant(x, dtype) for x in mj.jnt_range[joints].T)
    q = qpos[mj.jnt_qposadr[joints]]
    at_low = q - low < high - q
    axis, dist = constant(np.eye(mj.nv)[:, dofs], dtype), jnp.where(at_low, q - low, high - q)
    solref, solimp = mj.jnt_solref[joints], mj.jnt_solimp[joints]
    invweight = mj.dof_invweight0[dofs]
    params = SolverParams.create(mj, mj.jnt_margin[joints], invweight, solref, solimp)
    return _rows(as_arrays(params, dtype), axis * jnp.where(at_low, 1, -1), dist, qvel)


def _contact_rows(contact: Contact, smooth: Smooth, qvel: Array) -> Constraint:
    arm = contact.pos - smooth.subtree_com
    angular, linear = smooth.cdof[:, None, :3], smooth.cdof[:, None, 3:]
    velocity = linear + cross(angular, arm[None])
    velocity *= jnp.swapaxes(contact.params.dofs, 0, 1)[:, :, None]
    efc_J = normal = dot(velocity, contact.normal)
    if contact.dim == 3:  # the four edges of a pyramid
        slides = [contact.params.friction * dot(velocity, t) for t in _tangents(contact)]
        efc_J = jnp.concatenate([normal + sign * s for s in slides for sign in (1, -1)], 1)
    edges = efc_J.shape[1] // normal.shape[1]
    params, dist = jax.tree.map(
        lambda x: jnp.concatenate([x] * edges), (contact.params.solver, contact.dist)
    )
    return _rows(params, efc_J, dist, qvel)


def _tangents(contact: Contact) -> tuple[Array, Array]:
    return contact.tangent, cross(contact.normal, contact.tangent)


def _rows(params: SolverParams, efc_J: Array, dist: Array, qvel: Array) -> Constraint:
    """Compute `efc_R` = `efc_diagApprox` (1 − d)/d and `efc_aref` = −b J v − k d r.

    d(r) is MuJoCo's impedance at the violation r = dist − margin.
    """
    r = dist - params.margin
    low, high, width, midpoint, power = (params.solimp[:, i] for i in range(5))
    x = jnp.minimum(jnp.abs(r) / width, 1)
    below = x * (x / midpoint) ** (power - 1)
    above = 1 - (1 - x) * ((1 - x) / (1 - midpoint)) ** (power - 1)
    d = low + jnp.where(x < midpoint, below, above) * (high - low)
    efc_R = jnp.maximum(params.invweight * (1 - d) / d, mujoco.mjMINVAL)
    efc_aref = -combine(efc_J, qvel) * params.b - d * r * params.k
    return Constraint(efc_J, jnp.where(r < 0, 1 / efc_R, 0), efc_aref)


def rne_postconstraint(
    m: Model, contacts: list[Contact], subtree_com: Array, efc_force: Float[Array, "C N"]
) -> Float[Array, "B 6 N"]:
    """Compute `cfrc_ext`: torque about the center of mass of the tree and force on each body."""
    nbody, start = m.mj.nbody, np.count_nonzero(m.mj.jnt_limited)
    cfrc_ext = jnp.zeros((nbody, 6, subtree_com.shape[-1]), subtree_com.dtype)
    for contact in contacts:
        edges, count = 1 if contact.dim == 1 else 4, len(contact.dist)
        pyramid = efc_force[start : start + edges * count].reshape(edges, count, -1)
        start += edges * count
        force = contact.normal * pyramid.sum(0)[:, None]
        if contact.dim == 3:
            pairs = pyramid[:2], pyramid[2:]
            for tangent, (plus, minus) in zip(_tangents(contact), pairs, strict=True):
                force += tangent * (contact.params.friction * (plus - minus))[:, None]
        wrench = jnp.concatenate([cross(contact.pos - subtree_com, force), force], 1)
        bodies = jnp.arange(nbody)[:, None, None]
        for side, sign in ((0, -1), (1, 1)):
            on = jnp.where(contact.params.bodies[:, side] == bodies, sign, 0) * (bodies > 0)
            cfrc_ext += jnp.sum(on[:, :, None] * wrench, 1)
    return cfrc_ext
