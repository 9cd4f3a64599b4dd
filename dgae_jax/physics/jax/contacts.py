"""Where the limits and contacts of a scene are, and their constraint rows.

Distances, frames and rows are MuJoCo's: soft constraints, with pyramidal friction cones. A row asks for
J a ≥ a_ref, up to its regularisation R = 1/D; D is zero for a row that is not active (distance ≥ margin).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from dgae_jax.physics.jax.dynamics import Smooth, Tree
from dgae_jax.physics.jax.scene import Ends, Group, Scene, Softness, Touching
from dgae_jax.physics.jax.spatial import apply, combine, constant, cross, dot, unit


class Met(NamedTuple):
    """K contacts of W worlds: MuJoCo's `mjContact`."""

    touching: Touching
    """Their constants, as arrays."""
    distance: Float[Array, "K W"]
    """`contact.dist` [m]; negative: penetration."""
    position: Float[Array, "K 3 W"]
    """`contact.pos`, midway between the surfaces [m]."""
    normal: Float[Array, "K 3 W"]
    """The first axis of `contact.frame`, from the first body to the second."""
    tangent: Float[Array, "K 3 W"]
    """The second axis of `contact.frame`; the third is their cross product."""


class Rows(NamedTuple):
    """C constraint rows of W worlds."""

    jacobian: Float[Array, "V C W"]
    """`efc_J`, transposed."""
    stiffness: Float[Array, "C W"]
    """`efc_D`, the inverse of the regularisation `efc_R`; zero for a row that is not active."""
    reference: Float[Array, "C W"]
    """`efc_aref`, the reference acceleration."""


def constrain(
    scene: Scene, tree: Tree, smooth: Smooth, qpos: Array, qvel: Array
) -> tuple[Rows, list[Met]]:
    """The constraint rows of all limits, then of all contacts, and where the contacts are."""
    met = [_meet(group, smooth.frames) for group in scene.groups]
    parts = [_limit_rows(scene, tree.model, qpos, qvel)] if len(scene.limited) else []
    parts += [
        _contact_rows(group.frictionless, m, smooth, qvel)
        for group, m in zip(scene.groups, met, strict=True)
    ]
    jacobian, stiffness, reference = zip(*parts, strict=True)
    return Rows(
        jnp.concatenate(jacobian, 1), jnp.concatenate(stiffness), jnp.concatenate(reference)
    ), met


def _limit_rows(scene: Scene, model: mujoco.MjModel, qpos: Array, qvel: Array) -> Rows:
    low, high = (constant(x, qpos.dtype) for x in model.jnt_range[scene.limited].T)
    q = qpos[model.jnt_qposadr[scene.limited]]
    below = q - low < high - q
    axis = constant(np.eye(model.nv)[:, model.jnt_dofadr[scene.limited]], qpos.dtype)
    return _rows(
        _arrays(scene.softness, qpos.dtype),
        axis * jnp.where(below, 1, -1),
        jnp.where(below, q - low, high - q),
        qvel,
    )


def _contact_rows(frictionless: bool, met: Met, smooth: Smooth, qvel: Array) -> Rows:
    arm, (angular, linear) = (
        met.position - smooth.centre,
        (smooth.axes[:, None, :3], smooth.axes[:, None, 3:]),
    )
    moved = (linear + cross(angular, arm[None])) * jnp.swapaxes(met.touching.moves, 0, 1)[
        :, :, None
    ]
    jacobian = normal = dot(moved, met.normal)
    if not frictionless:  # the four edges of a pyramid
        slides = [
            met.touching.friction * dot(moved, t)
            for t in (met.tangent, cross(met.normal, met.tangent))
        ]
        jacobian = jnp.concatenate(
            [normal + sign * slide for slide in slides for sign in (1, -1)], 1
        )
    edges = jacobian.shape[1] // normal.shape[1]
    softness, distance = jax.tree.map(
        lambda x: jnp.concatenate([x] * edges), (met.touching.softness, met.distance)
    )
    return _rows(softness, jacobian, distance, qvel)


def _rows(softness: Softness, jacobian: Array, distance: Array, qvel: Array) -> Rows:
    """MuJoCo's impedance d(r), regularisation `efc_R` = `efc_diagApprox` (1 − d)/d and `efc_aref` = −b (J v) − k d r."""
    gap = distance - softness.margin
    low, high, width, middle, power = (softness.impedance[:, i] for i in range(5))
    x = jnp.minimum(jnp.abs(gap) / width, 1)
    rise = jnp.where(
        x < middle,
        x * (x / middle) ** (power - 1),
        1 - (1 - x) * ((1 - x) / (1 - middle)) ** (power - 1),
    )
    impedance = low + rise * (high - low)
    regularisation = jnp.maximum(
        softness.inverse_weight * (1 - impedance) / impedance, mujoco.mjMINVAL
    )
    reference = -combine(jacobian, qvel) * softness.damping - impedance * gap * softness.stiffness
    return Rows(jacobian, jnp.where(gap < 0, 1 / regularisation, 0), reference)


def _arrays(constants, dtype):
    return jax.tree.map(lambda x: constant(x, dtype), constants)


def _place(ends: Ends, frames: Array) -> tuple[Array, Array]:
    """Centres and half axes in the world."""
    here = frames[ends.frame]
    turn = here[:, :, :3]
    return here[:, :, 3] + apply(turn, constant(ends.centre, frames.dtype)), apply(
        turn, constant(ends.half, frames.dtype)
    )


def _meet(group: Group, frames: Array) -> Met:
    centre, half = _place(group.second, frames)
    if group.first is not None:
        return _between(group, *_place(group.first, frames), centre, half)
    plane, radius = constant(group.plane, frames.dtype), constant(group.second.radius, frames.dtype)
    distance, normal = dot(centre, plane[:, :3]) - plane[:, 3] - radius, plane[:, :3] + 0 * centre
    position = centre - normal * (radius + 0.5 * distance)[:, None]
    flat = half - normal * dot(half, normal)[:, None]  # the capsule's axis on the ground
    upright = dot(flat, flat) <= 1e-12 * dot(half, half)
    return _nearest(
        group,
        distance,
        position,
        normal,
        jnp.where(upright[:, None], _any_tangent(normal), unit(flat)),
    )


def _between(group: Group, one: Array, half_one: Array, two: Array, half_two: Array) -> Met:
    """Nearest points of two segments: of the first's line to the second's, cut to the segments one after the other."""
    a, b, c = dot(half_one, half_one), -dot(half_one, half_two), dot(half_two, half_two)
    u, v = dot(half_one, two - one), dot(half_two, one - two)
    parallel, a, c = a * c - b * b <= 0, jnp.where(a > 0, a, 1), jnp.where(c > 0, c, 1)
    x = jnp.clip((c * u - b * v) / jnp.where(parallel, 1, a * c - b * b), -1, 1)
    y = jnp.clip((v - b * x) / c, -1, 1)
    x = jnp.clip((u - b * y) / a, -1, 1)
    start, reach = (
        one + x[:, None] * half_one,
        two + y[:, None] * half_two - one - x[:, None] * half_one,
    )
    radii = [constant(e.radius, one.dtype) for e in (group.first, group.second) if e is not None]
    distance, normal = jnp.sqrt(dot(reach, reach)) - sum(radii), unit(reach)
    return _nearest(
        group,
        distance,
        start + normal * (radii[0] + 0.5 * distance)[:, None],
        normal,
        _any_tangent(normal),
    )


def _any_tangent(normal: Array) -> Array:
    """MuJoCo's tangent where nothing else gives one: y, or z where the normal is along y."""
    y, z = (
        constant(np.array([0, 1.0, 0]), normal.dtype),
        constant(np.array([0, 0, 1.0]), normal.dtype),
    )
    axis = jnp.where(jnp.abs(normal[:, 1:2]) < 0.5, y, z)
    return unit(axis - normal * dot(axis + 0 * normal, normal)[:, None])


def _nearest(group: Group, distance: Array, *where: Array) -> Met:
    """All contacts of a group, or as many of the nearest as are kept."""
    if group.most == len(distance):
        return Met(_arrays(group.touching, distance.dtype), distance, *where)
    chosen = jax.lax.top_k(-distance.T, group.most)[1].T

    def constants(x: np.ndarray) -> Array:
        if (x == x[:1]).all():
            return constant(x[: group.most], distance.dtype)
        return jnp.moveaxis(
            jnp.take(jnp.asarray(np.moveaxis(x, 0, -1), distance.dtype), chosen, axis=-1), -2, 0
        )

    def take(x: Array) -> Array:
        return jnp.take_along_axis(x, chosen.reshape(group.most, *(1,) * (x.ndim - 2), -1), 0)

    return Met(jax.tree.map(constants, group.touching), *map(take, (distance, *where)))


def contact_forces(
    scene: Scene, model: mujoco.MjModel, met: list[Met], centre: Array, pushes: Array
) -> Float[Array, "B 6 W"]:
    """`cfrc_ext`: torque about the tree's centre of mass and force on each body, from the `efc_force` of the rows."""
    out, at = jnp.zeros((model.nbody, 6, centre.shape[-1]), centre.dtype), len(scene.limited)
    for group, m in zip(scene.groups, met, strict=True):
        edges, count = 1 if group.frictionless else 4, len(m.distance)
        push = pushes[at : at + edges * count].reshape(edges, count, -1)
        at += edges * count
        force = m.normal * push.sum(0)[:, None]
        if not group.frictionless:
            for tangent, (plus, minus) in (
                (m.tangent, push[:2]),
                (cross(m.normal, m.tangent), push[2:]),
            ):
                force += tangent * (m.touching.friction * (plus - minus))[:, None]
        wrench = jnp.concatenate([cross(m.position - centre, force), force], 1)
        bodies = jnp.arange(model.nbody)[:, None, None]
        for side, sign in ((0, -1), (1, 1)):
            on = jnp.where(m.touching.bodies[:, side] == bodies, sign, 0) * (bodies > 0)
            out += jnp.sum(on[:, :, None] * wrench, 1)
    return out
