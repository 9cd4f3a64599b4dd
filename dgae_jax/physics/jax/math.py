"""Vectors, rotations, spatial motions and small linear systems of N envs.

The env axis is the last, so that every operation runs along it. Axes marked # in the annotations
broadcast. 6-vectors are rotation before translation, as in MuJoCo.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def constant(x: np.ndarray, dtype: jnp.dtype) -> Array:
    """Return a constant of the model with an env axis."""
    return jnp.asarray(x, dtype)[..., None]


def dot(a: Float[Array, "*#n K #N"], b: Float[Array, "*#n K #N"]) -> Array:
    """Inner product along the axis before the envs."""
    return sum(a[..., k, :] * b[..., k, :] for k in range(a.shape[-2]))  # pyright: ignore


def cross(a: Float[Array, "*#n 3 #N"], b: Float[Array, "*#n 3 #N"]) -> Array:
    """Cross product along the axis before the envs."""
    (x, y, z), (u, v, w) = (tuple(c[..., k, :] for k in range(3)) for c in (a, b))
    return jnp.stack([y * w - z * v, z * u - x * w, x * v - y * u], -2)


def matvec(matrix: Float[Array, "*#n M K #N"], vector: Float[Array, "*#n K #N"]) -> Array:
    """Matrix times vector."""
    terms = (matrix[..., k, :] * vector[..., None, k, :] for k in range(matrix.shape[-2]))
    return sum(terms)  # pyright: ignore


def matmul(a: Float[Array, "*#n M K #N"], b: Float[Array, "*#n K L #N"]) -> Array:
    """Matrix times matrix."""
    terms = (a[..., :, k, None, :] * b[..., None, k, :, :] for k in range(a.shape[-2]))
    return sum(terms)  # pyright: ignore


def combine(x: Float[Array, "n *k N"], weights: Float[Array, "n N"]) -> Array:
    """Σᵢ xᵢ wᵢ, unrolled: XLA's own reduction costs ten times as much on a CPU."""
    return sum(x[i] * weights[i] for i in range(len(weights)))  # pyright: ignore


def masked_sum(mask: np.ndarray, x: Float[Array, "n *k N"]) -> Float[Array, "m *k N"]:
    """Weighted sums along the first axis, as one product with a constant matrix [m, n]."""
    flat = x.reshape(len(x), math.prod(x.shape[1:]))
    return (jnp.asarray(mask, x.dtype) @ flat).reshape(len(mask), *x.shape[1:])


def normalize(x: Float[Array, "*n K N"]) -> Float[Array, "*n K N"]:
    """x over its length; zero stays zero."""
    length = jnp.sqrt(dot(x, x))[..., None, :]
    return x / jnp.where(length > 0, length, 1)


def quat_to_mat(quat: Float[Array, "4 N"]) -> Float[Array, "3 3 N"]:
    """Rotation matrix of a quaternion of any length."""
    w, x, y, z = normalize(quat)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def quat_integrate(quat: Float[Array, "4 N"], angle: Float[Array, "3 N"]) -> Float[Array, "4 N"]:
    """Rotate a unit quaternion by a rotation vector in its own frame."""
    half = 0.5 * jnp.sqrt(dot(angle, angle))
    w, xyz = jnp.cos(half), jnp.sin(half) * normalize(angle)
    q = normalize(quat)
    real = (q[0] * w - dot(q[1:], xyz))[None]
    return normalize(jnp.concatenate([real, q[0] * xyz + w * q[1:] + cross(q[1:], xyz)]))


class Inertia(NamedTuple):
    """Spatial inertia of B bodies about the center of mass of the tree, in the world frame."""

    rotational: Float[Array, "B 3 3 N"]
    moment: Float[Array, "B 3 N"]
    """Mass times offset from the center of mass of the tree."""
    mass: Float[Array, "B 1 #N"]


def inert_mul(i: Inertia, motion: Float[Array, "B 6 N"]) -> Float[Array, "B 6 N"]:
    """Spatial inertia times motion."""
    angular, linear = motion[:, :3], motion[:, 3:]
    torque = matvec(i.rotational, angular) + cross(i.moment, linear)
    return jnp.concatenate([torque, i.mass * linear + cross(angular, i.moment)], 1)


def motion_cross(u: Float[Array, "B 6 N"], v: Float[Array, "B 6 N"]) -> Float[Array, "B 6 N"]:
    """Cross product of two motions: the rate of v when u carries it."""
    angular = cross(u[:, :3], v[:, :3])
    linear = cross(u[:, :3], v[:, 3:]) + cross(u[:, 3:], v[:, :3])
    return jnp.concatenate([angular, linear], 1)


def motion_cross_force(v: Float[Array, "B 6 N"], f: Float[Array, "B 6 N"]) -> Array:
    """Cross product of a motion and a force: the rate of f when v carries it."""
    torque = cross(v[:, :3], f[:, :3]) + cross(v[:, 3:], f[:, 3:])
    return jnp.concatenate([torque, cross(v[:, :3], f[:, 3:])], 1)


def solve(matrix: Float[Array, "V V N"], vector: Float[Array, "V N"]) -> Float[Array, "V N"]:
    """Solve symmetric positive definite systems by elimination.

    A loop compiles fast and is as fast on a CPU; on an accelerator each turn costs a launch.
    """
    size = len(vector)

    def eliminate(rows, k, pivot):
        row = rows[k] / rows[k, pivot]
        factor = rows[:, pivot] - (jnp.arange(size)[:, None] == k)  # leaves row k over its pivot
        return rows - factor[:, None] * row

    def loop(rows):
        return jax.lax.scan(lambda r, k: (eliminate(r, k, k), None), rows, jnp.arange(size))[0]

    def unrolled(rows):
        for k in range(size):  # a column is not needed after its elimination
            rows = eliminate(rows, k, 0)[:, 1:]
        return rows

    rows = jnp.concatenate([matrix, vector[:, None]], 1)
    return jax.lax.platform_dependent(
        rows, cpu=lambda rows: loop(rows)[:, size], default=lambda rows: unrolled(rows)[:, 0]
    )
