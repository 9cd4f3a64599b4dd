"""Contacts of spheres and capsules with planes and with each other."""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from dgae_jax.physics.jax.math import constant, dot, matvec, normalize
from dgae_jax.physics.jax.model import CAPSULE, PLANE, Constants, Model, SolverParams, quat_to_mat

_MAX_CONTACTS = {("ant", 25): 8, ("walker2d", 14): 10}
"""More ground contacts than Gymnasium's models ever have, by name and number of possible ones."""


class Geoms(NamedTuple):
    """K spheres or capsules, fixed to frames of joints."""

    frame: np.ndarray
    pos: np.ndarray
    """[K 3] center in that frame [m]."""
    half: np.ndarray
    """[K 3] half the axis of a capsule in that frame [m]; zero for a sphere."""
    radius: np.ndarray


class ContactParams(NamedTuple):
    """Constants of K possible contacts."""

    solver: SolverParams
    friction: Constants
    """[K] sliding friction."""
    dofs: Constants
    """[K V] 1 where a degree of freedom moves the second body, −1 the first, 0 both or none."""
    bodies: Constants
    """[K 2] `geom_bodyid` of `contact.geom`."""


class ContactGroup(NamedTuple):
    """Possible contacts that are found and kept in the same way."""

    dim: int
    params: ContactParams
    geom1: Geoms | np.ndarray
    """For the ground its planes [K 4]: normal and offset [1, m]."""
    geom2: Geoms
    max_contacts: int
    """Number of contacts that are kept, the nearest ones."""


class Contact(NamedTuple):
    """Fields of `mjContact` of K contacts in N envs, with two of the axes of its `frame`."""

    dim: int
    params: ContactParams
    dist: Float[Array, "K N"]
    pos: Float[Array, "K 3 N"]
    normal: Float[Array, "K 3 N"]
    tangent: Float[Array, "K 3 N"]


def contact_groups(m: Model, name: str) -> list[ContactGroup]:
    """Read the possible contacts of the model `name`."""
    mj = m.mj
    pairs: dict[tuple[bool, int], list[tuple[int, int]]] = {}
    for pair in _geom_pairs(mj):
        dim = 1 if max(mj.geom_condim[list(pair)]) == 1 else 3
        pairs.setdefault((bool(mj.geom_type[pair[0]] == PLANE), dim), []).append(pair)
    return [_group(m, name, np.array(p), *kind) for kind, p in pairs.items()]


def _geom_pairs(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Yield the pairs of geoms that MuJoCo tests, ordered by their type."""
    weld, parent = model.body_weldid, model.body_parentid
    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    geoms = np.lexsort((np.arange(model.ngeom), model.geom_type))
    for i, one in enumerate(geoms):
        for two in geoms[i + 1 :]:
            a, b = (weld[model.geom_bodyid[g]] for g in (one, two))
            related = a and b and (weld[parent[a]] == b or weld[parent[b]] == a)
            collide = contype[one] & conaffinity[two] or contype[two] & conaffinity[one]
            if a != b and not related and collide:
                yield int(one), int(two)


def _group(m: Model, name: str, pairs: np.ndarray, ground: bool, dim: int) -> ContactGroup:
    mj = m.mj
    if ground:  # a capsule touches the ground with either end
        signs = [(1, -1) if mj.geom_type[two] == CAPSULE else (1,) for _, two in pairs]
        ends = np.array([(*p, s) for p, both in zip(pairs, signs, strict=True) for s in both])
        pairs, geom2 = ends[:, :2], _geoms(m, ends[:, 1])
        geom2 = geom2._replace(pos=geom2.pos + ends[:, 2:] * geom2.half)
    else:
        geom2 = _geoms(m, pairs[:, 1])
    one, two = pairs.T
    bodies = mj.geom_bodyid[pairs]
    friction = np.maximum(mj.geom_friction[one, 0], mj.geom_friction[two, 0])
    invweight = mj.body_invweight0[bodies, 0].sum(1)
    if dim == 3:
        invweight = 2 * friction**2 / mj.opt.impratio * (1 + friction**2) * invweight
    solref, solimp = mj.geom_solref[pairs].mean(1), mj.geom_solimp[pairs].mean(1)
    solver = SolverParams.create(mj, mj.geom_margin[pairs].sum(1), invweight, solref, solimp)
    dofs = np.concatenate([np.zeros((1, mj.nv)), m.body_dofs])[bodies]
    params = ContactParams(solver, friction, dofs[:, 1] - dofs[:, 0], bodies)
    if not ground:
        return ContactGroup(dim, params, _geoms(m, one), geom2, len(pairs))
    normals = np.array([quat_to_mat(mj.geom_quat[g])[:, 2] for g in one])
    planes = np.c_[normals, (normals * mj.geom_pos[one]).sum(1)]
    max_contacts = _MAX_CONTACTS.get((name, len(pairs)), len(pairs))
    return ContactGroup(dim, params, planes, geom2, max_contacts)


def _geoms(m: Model, geoms: np.ndarray) -> Geoms:
    mj = m.mj
    poses = [m.bodies[mj.geom_bodyid[g]].at(mj.geom_pos[g], mj.geom_quat[g]) for g in geoms]
    frame, pos, mat = (np.array(x) for x in zip(*poses, strict=True))
    length = mj.geom_size[geoms, 1] * (mj.geom_type[geoms] == CAPSULE)
    return Geoms(frame, pos, mat[:, :, 2] * length[:, None], mj.geom_size[geoms, 0])


def collision(groups: list[ContactGroup], frames: Float[Array, "F 3 4 N"]) -> list[Contact]:
    """Find the contacts of each group."""
    return [
        _capsule_capsule(g, g.geom1, frames)
        if isinstance(g.geom1, Geoms)
        else _plane_capsule(g, g.geom1, frames)
        for g in groups
    ]


def _xpos(geoms: Geoms, frames: Array) -> tuple[Array, Array]:
    """Return centers and half axes in the world frame."""
    body = frames[geoms.frame]
    mat = body[:, :, :3]
    center = body[:, :, 3] + matvec(mat, constant(geoms.pos, frames.dtype))
    return center, matvec(mat, constant(geoms.half, frames.dtype))


def _plane_capsule(group: ContactGroup, planes: np.ndarray, frames: Array) -> Contact:
    """Contacts of the ends of capsules, or of spheres, with the ground."""
    end, half = _xpos(group.geom2, frames)
    plane = constant(planes, frames.dtype)
    radius = constant(group.geom2.radius, frames.dtype)
    dist, normal = dot(end, plane[:, :3]) - plane[:, 3] - radius, plane[:, :3] + 0 * end
    pos = end - normal * (radius + 0.5 * dist)[:, None]
    along = half - normal * dot(half, normal)[:, None]
    upright = dot(along, along) <= 1e-12 * dot(half, half)
    tangent = jnp.where(upright[:, None], _any_tangent(normal), normalize(along))
    return _nearest(group, dist, pos, normal, tangent)


def _capsule_capsule(group: ContactGroup, geom1: Geoms, frames: Array) -> Contact:
    """Contacts at the nearest points of two segments, as MuJoCo finds them."""
    pos2, half2 = _xpos(group.geom2, frames)
    pos1, half1 = _xpos(geom1, frames)
    a, b, c = dot(half1, half1), -dot(half1, half2), dot(half2, half2)
    u, v = dot(half1, pos2 - pos1), dot(half2, pos1 - pos2)
    parallel, a, c = a * c - b * b <= 0, jnp.where(a > 0, a, 1), jnp.where(c > 0, c, 1)
    x1 = jnp.clip((c * u - b * v) / jnp.where(parallel, 1, a * c - b * b), -1, 1)
    x2 = jnp.clip((v - b * x1) / c, -1, 1)
    x1 = jnp.clip((u - b * x2) / a, -1, 1)
    start = pos1 + x1[:, None] * half1
    apart = pos2 + x2[:, None] * half2 - pos1 - x1[:, None] * half1
    radius1, radius2 = (constant(g.radius, pos1.dtype) for g in (geom1, group.geom2))
    dist, normal = jnp.sqrt(dot(apart, apart)) - (0 + radius1 + radius2), normalize(apart)
    pos = start + normal * (radius1 + 0.5 * dist)[:, None]
    return _nearest(group, dist, pos, normal, _any_tangent(normal))


def _any_tangent(normal: Array) -> Array:
    """Return MuJoCo's default tangent: y, or z where the normal is along y."""
    y, z = (constant(np.eye(3)[i], normal.dtype) for i in (1, 2))
    axis = jnp.where(jnp.abs(normal[:, 1:2]) < 0.5, y, z)
    return normalize(axis - normal * dot(axis + 0 * normal, normal)[:, None])


def as_arrays(params, dtype: jnp.dtype):
    """Return the constants of a model as arrays with an env axis."""
    return jax.tree.map(lambda x: constant(x, dtype), params)


def _nearest(group: ContactGroup, dist: Array, *rest: Array) -> Contact:
    """Keep all contacts of a group, or the `max_contacts` nearest."""
    count = group.max_contacts
    if count == len(dist):
        return Contact(group.dim, as_arrays(group.params, dist.dtype), dist, *rest)
    chosen = jax.lax.top_k(-dist.T, count)[1].T

    def constants(x: np.ndarray) -> Array:
        if (x == x[:1]).all():
            return constant(x[:count], dist.dtype)
        last = jnp.asarray(np.moveaxis(x, 0, -1), dist.dtype)
        return jnp.moveaxis(jnp.take(last, chosen, axis=-1), -2, 0)

    def take(x: Array) -> Array:
        return jnp.take_along_axis(x, chosen.reshape(count, *(1,) * (x.ndim - 2), -1), 0)

    return Contact(group.dim, jax.tree.map(constants, group.params), *map(take, (dist, *rest)))
