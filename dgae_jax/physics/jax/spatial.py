"""Vectors, rotations and small systems of many worlds at once: the world is the last axis, so that every operation runs along it.

Axes marked # in the annotations broadcast.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def constant(x: np.ndarray, dtype: jnp.dtype) -> Array:
    """A constant of the model beside arrays with worlds."""
    return jnp.asarray(x, dtype)[..., None]


def dot(a: Float[Array, "*#n K #W"], b: Float[Array, "*#n K #W"]) -> Array:
    """Inner product along the axis before the worlds."""
    return sum(a[..., k, :] * b[..., k, :] for k in range(a.shape[-2]))  # pyright: ignore[reportReturnType]


def cross(a: Float[Array, "*#n 3 #W"], b: Float[Array, "*#n 3 #W"]) -> Array:
    """a × b."""
    (x, y, z), (u, v, w) = (tuple(c[..., k, :] for k in range(3)) for c in (a, b))
    return jnp.stack([y * w - z * v, z * u - x * w, x * v - y * u], -2)


def apply(matrix: Float[Array, "*#n M K #W"], vector: Float[Array, "*#n K #W"]) -> Array:
    """Matrix times vector."""
    return sum(matrix[..., k, :] * vector[..., None, k, :] for k in range(matrix.shape[-2]))  # pyright: ignore[reportReturnType]


def combine(x: Float[Array, "n *k W"], by: Float[Array, "n W"]) -> Array:
    """Σᵢ xᵢ byᵢ, written out: XLA's own reduction costs ten times as much on a CPU."""
    return sum(x[i] * by[i] for i in range(len(by)))  # pyright: ignore[reportReturnType]


def compose(a: Float[Array, "*#n M K #W"], b: Float[Array, "*#n K N #W"]) -> Array:
    """Matrix times matrix."""
    return sum(a[..., :, k, None, :] * b[..., None, k, :, :] for k in range(a.shape[-2]))  # pyright: ignore[reportReturnType]


def total(mask: np.ndarray, x: Float[Array, "n *k W"]) -> Float[Array, "m *k W"]:
    """Weighted sums along the first axis, as one product with a constant matrix m × n."""
    return (jnp.asarray(mask, x.dtype) @ x.reshape(len(x), math.prod(x.shape[1:]))).reshape(
        len(mask), *x.shape[1:]
    )


def unit(x: Float[Array, "*n K W"]) -> Float[Array, "*n K W"]:
    """x over its length; zero stays zero."""
    length = jnp.sqrt(dot(x, x))[..., None, :]
    return x / jnp.where(length > 0, length, 1)


def rotation(quat: Float[Array, "4 W"]) -> Float[Array, "3 3 W"]:
    """The matrix of a quaternion of any length."""
    w, x, y, z = unit(quat)
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def rotate(quat: Float[Array, "4 W"], angle: Float[Array, "3 W"]) -> Float[Array, "4 W"]:
    """A unit quaternion turned by a rotation vector in its own frame."""
    half = 0.5 * jnp.sqrt(dot(angle, angle))
    w, xyz = jnp.cos(half), jnp.sin(half) * unit(angle)
    q = unit(quat)
    return unit(
        jnp.concatenate(
            [(q[0] * w - dot(q[1:], xyz))[None], q[0] * xyz + w * q[1:] + cross(q[1:], xyz)]
        )
    )


def solve(matrix: Float[Array, "V V W"], vector: Float[Array, "V W"]) -> Float[Array, "V W"]:
    """x with matrix · x = vector, for symmetric positive definite matrices, by elimination.

    A loop compiles fast and is as fast on a CPU; on an accelerator each of its turns would cost a launch.
    """
    size = len(vector)

    def eliminate(rows, k):
        row = rows[k] / rows[k, k]
        column = rows[:, k] - (
            jnp.arange(size)[:, None] == k
        )  # leaves the row itself divided by its pivot
        return rows - column[:, None] * row, None

    def written_out(rows):
        for k in range(size):  # the first column is that of the pivot, and is not needed again
            row = rows[k] / rows[k, 0]
            rows = rows[:, 1:] - rows[:, 0].at[k].add(-1)[:, None] * row[1:]
        return rows[:, 0]

    def in_a_loop(rows):
        return jax.lax.scan(eliminate, rows, jnp.arange(size))[0][:, size]

    return jax.lax.platform_dependent(
        jnp.concatenate([matrix, vector[:, None]], 1), cpu=in_a_loop, default=written_out
    )
