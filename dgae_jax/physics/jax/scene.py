"""What may constrain a tree: its joint limits, and the contacts of its spheres and capsules with the ground and each other.

The constants of MuJoCo's soft constraints, read once from the model.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Array

from dgae_jax.physics.jax.dynamics import Tree

_PLANE, _CAPSULE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)


Numbers = np.ndarray | Array
"""Constants of the model, which become arrays where a world keeps only some contacts."""

_CONTACTS = {("ant", 25): 8, ("walker2d", 14): 10}
"""More contacts with the ground than the models of Gymnasium ever have at once, by the model's name and by how many are possible."""


class Softness(NamedTuple):
    """The solver parameters of K limits or contacts."""

    margin: Numbers
    """[K] `jnt_margin`, or the `margin` of a contact [m, rad]: a constraint acts below this distance."""
    inverse_weight: Numbers
    """[K] `efc_diagApprox`: approximate inverse inertia along the row [1/kg, or per kg m²]."""
    stiffness: Numbers
    """[K] k of the reference acceleration, from `solref` [1/s²]."""
    damping: Numbers
    """[K] b of the reference acceleration, from `solref` [1/s]."""
    impedance: Numbers
    """[K 5] `solimp`: d_0, d_width, width, midpoint, power."""


class Ends(NamedTuple):
    """K spheres or capsules, fixed to frames."""

    frame: np.ndarray
    """[K] the joint's frame that the geom is fixed to."""
    centre: np.ndarray
    """[K 3] `geom_pos` in that frame [m]."""
    half: np.ndarray
    """[K 3] half the axis of a capsule in that frame, `geom_size[1]` along z of `geom_quat` [m]; zero for a sphere."""
    radius: np.ndarray
    """[K] `geom_size[0]` [m]."""


class Touching(NamedTuple):
    """The constants of K possible contacts."""

    softness: Softness
    friction: Numbers
    """[K] sliding friction of `contact.friction` [1]."""
    moves: Numbers
    """[K V] how a degree of freedom moves the second body against the first: 1, 0 or −1."""
    bodies: Numbers
    """[K 2] `geom_bodyid` of `contact.geom`."""


class Group(NamedTuple):
    """Possible contacts that are found and kept in the same way."""

    touching: Touching
    first: Ends | None
    """The first of `contact.geom`; None for the ground, a plane."""
    second: Ends
    """The second of `contact.geom`."""
    plane: np.ndarray
    """[K 4] normal and offset of the ground [1, m]."""
    frictionless: bool
    """Whether `contact.dim` is 1; it is 3 otherwise."""
    most: int
    """How many are kept, the nearest ones."""


class Scene(NamedTuple):
    """All that may constrain a tree."""

    limited: np.ndarray
    """The joints with `jnt_limited`."""
    softness: Softness
    """Solver parameters of the limits."""
    groups: list[Group]
    """The contacts."""


def known_bound(name: str, model: mujoco.MjModel) -> int | None:
    """The bound on contacts with the ground that is known for a model of this name; None where none is."""
    ground = [two for one, two in _pairs(model) if model.geom_type[one] == _PLANE]
    return _CONTACTS.get(
        (name, sum(2 if model.geom_type[two] == _CAPSULE else 1 for two in ground))
    )


def scene_of(tree: Tree, most: int | None = None) -> Scene:
    """Read limits and contacts of a model; `most` bounds the contacts with the ground, of which the nearest are kept."""
    model = tree.model
    limited = np.flatnonzero(model.jnt_limited)
    weights = model.dof_invweight0[model.jnt_dofadr[limited]]
    softness = _softness(
        model,
        model.jnt_margin[limited],
        weights,
        model.jnt_solref[limited],
        model.jnt_solimp[limited],
    )
    pairs: dict[tuple[bool, bool], list[tuple[int, int]]] = {}
    for one, two in _pairs(model):
        kind = bool(model.geom_type[one] == _PLANE), bool(max(model.geom_condim[[one, two]]) == 1)
        pairs.setdefault(kind, []).append((one, two))
    groups = [
        _group(tree, np.array(p), ground, frictionless, most)
        for (ground, frictionless), p in pairs.items()
    ]
    return Scene(limited, softness, groups)


def _pairs(model: mujoco.MjModel):
    """The pairs of geoms that MuJoCo tests, ordered by their type."""
    weld, geoms = model.body_weldid, np.lexsort((np.arange(model.ngeom), model.geom_type))
    for i, one in enumerate(geoms):
        for two in geoms[i + 1 :]:
            a, b = (weld[model.geom_bodyid[g]] for g in (one, two))
            related = (
                a and b and (weld[model.body_parentid[a]] == b or weld[model.body_parentid[b]] == a)
            )
            wanted = (
                model.geom_contype[one] & model.geom_conaffinity[two]
                or model.geom_contype[two] & model.geom_conaffinity[one]
            )
            if a != b and not related and wanted:
                yield int(one), int(two)


def _group(
    tree: Tree, pairs: np.ndarray, ground: bool, frictionless: bool, most: int | None
) -> Group:
    model = tree.model
    if ground:  # a capsule touches the ground with either end
        tips = np.array(
            [
                (*pair, sign)
                for pair in pairs
                for sign in ((1, -1) if model.geom_type[pair[1]] == _CAPSULE else (1,))
            ]
        )
        pairs, second = tips[:, :2], _ends(tree, tips[:, 1])
        second = second._replace(centre=second.centre + tips[:, 2:] * second.half)
    else:
        second = _ends(tree, pairs[:, 1])
    one, two = pairs.T
    bodies = model.geom_bodyid[pairs]
    friction = np.maximum(model.geom_friction[one, 0], model.geom_friction[two, 0])
    weight = model.body_invweight0[bodies, 0].sum(1)
    if not frictionless:
        weight = 2 * friction**2 / model.opt.impratio * (1 + friction**2) * weight
    solref, solimp = model.geom_solref[pairs].mean(1), model.geom_solimp[pairs].mean(1)
    softness = _softness(model, model.geom_margin[pairs].sum(1), weight, solref, solimp)
    moves = np.concatenate([np.zeros((1, model.nv)), tree.moves])[bodies]
    normals = np.array(
        [tree.bodies[0].at(np.zeros(3), model.geom_quat[g]).rotation[:, 2] for g in one]
    )
    plane = np.c_[normals, (normals * model.geom_pos[one]).sum(1)]
    touching = Touching(softness, friction, moves[:, 1] - moves[:, 0], bodies)
    kept = min(len(pairs), most) if ground and most is not None else len(pairs)
    return Group(touching, None if ground else _ends(tree, one), second, plane, frictionless, kept)


def _ends(tree: Tree, geoms: np.ndarray) -> Ends:
    model = tree.model
    poses = [
        tree.bodies[model.geom_bodyid[g]].at(model.geom_pos[g], model.geom_quat[g]) for g in geoms
    ]
    length = model.geom_size[geoms, 1] * (model.geom_type[geoms] == _CAPSULE)
    half = np.array([pose.rotation[:, 2] for pose in poses]) * length[:, None]
    return Ends(
        np.array([pose.frame for pose in poses]),
        np.array([pose.position for pose in poses]),
        half,
        model.geom_size[geoms, 0],
    )


def _softness(
    model: mujoco.MjModel,
    margin: np.ndarray,
    weight: np.ndarray,
    solref: np.ndarray,
    solimp: np.ndarray,
) -> Softness:
    """MuJoCo's stiffness and damping from `solref`, given as time constant and damping ratio or, negative, directly."""
    low, high, width, middle, power = solimp.T
    low, high, middle = (np.clip(x, mujoco.mjMINIMP, mujoco.mjMAXIMP) for x in (low, high, middle))
    time, ratio = solref.T
    safe = np.maximum(time, 2 * model.opt.timestep)
    stiffness = np.where(time > 0, 1 / (high * safe * ratio) ** 2, -time / high**2)
    damping = np.where(ratio > 0, 2 / (high * safe), -ratio / high)
    impedance = np.stack(
        [low, high, np.maximum(width, mujoco.mjMINVAL), middle, np.maximum(power, 1)], 1
    )
    return Softness(margin, weight, stiffness, damping, impedance)
