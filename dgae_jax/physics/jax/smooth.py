"""Smooth dynamics of a kinematic tree, before constraints: pose, mass matrix, forces.

MuJoCo's quantities in MuJoCo's conventions: 6-vectors are taken about the center of mass of the
tree. A sum over ancestors or descendants is one product with a constant matrix of zeros and ones.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from dgae_jax.physics.jax import math
from dgae_jax.physics.jax.math import Inertia, constant, cross, dot, masked_sum, matmul, matvec
from dgae_jax.physics.jax.model import SLIDE, Model


class Smooth(NamedTuple):
    """Fields of `mjData` before constraints."""

    frames: Float[Array, "F 3 4 N"]
    """Rotation and position of each joint's frame: `xmat` and `xpos` of the body behind it."""
    subtree_com: Float[Array, "3 N"]
    cdof: Float[Array, "V 6 N"]
    qM: Float[Array, "V V N"]
    qfrc_smooth: Float[Array, "V N"]
    """Motors, springs, dampers, gravity, fluid and bias [N, N m]."""


def smooth(
    m: Model, qpos: Float[Array, "Q N"], qvel: Float[Array, "V N"], ctrl: Float[Array, "U N"]
) -> Smooth:
    """Compute everything but constraints."""
    frames = kinematics(m, qpos)
    xmat, offset, subtree_com, cdof, cinert = com_pos(m, frames)
    cvel, cacc = com_vel(m, cdof, qvel)
    cfrc = math.inert_mul(cinert, cacc)
    cfrc = cfrc + math.motion_cross_force(cvel, math.inert_mul(cinert, cvel))
    if m.mj.opt.density > 0 or m.mj.opt.viscosity > 0:
        cfrc = cfrc - _inertia_box_fluid_model(m, xmat, offset, cvel)
    qM, qfrc_bias = crb_rne(m, cdof, cinert, cfrc)
    return Smooth(frames, subtree_com, cdof, qM, _applied(m, qpos, qvel, ctrl) - qfrc_bias)


def kinematics(m: Model, qpos: Float[Array, "Q N"]) -> Float[Array, "F 3 4 N"]:
    """Compute rotation and position of the root's frame and of each joint's, behind the joint."""
    joints = np.arange(int(m.has_free_root), m.mj.njnt)
    address = m.mj.jnt_qposadr[joints]
    angle = qpos[address] - constant(m.mj.qpos0[address], qpos.dtype)
    local = constant(m.joint_terms[:, 0], qpos.dtype)
    local += sum(
        constant(m.joint_terms[:, i], qpos.dtype) * x[:, None, None]
        for i, x in enumerate((jnp.sin(angle), 1 - jnp.cos(angle), angle), 1)
    )
    root = constant(np.eye(3, 4), qpos.dtype) + 0 * qpos[0]
    if m.has_free_root:
        root = jnp.concatenate([math.quat_to_mat(qpos[3:7]), qpos[:3, None]], 1)

    def attach(frames, joint):
        frame, parent, pose = joint
        pose = jnp.concatenate([pose, constant(np.eye(4)[3:], qpos.dtype) + 0 * pose[:1]])
        return frames.at[frame].set(matmul(frames[parent], pose)), None

    def loop(frames, local):
        numbers = jnp.arange(len(joints)) + 1, jnp.asarray(m.joint_parent)
        return jax.lax.scan(attach, frames, (*numbers, local))[0]

    def unrolled(frames, local):  # an accelerator pays a launch for each turn of a loop
        for joint, parent in enumerate(m.joint_parent.tolist()):
            frames, _ = attach(frames, (joint + 1, parent, local[joint]))
        return frames

    frames = jnp.zeros((len(joints) + 1, *root.shape), qpos.dtype).at[0].set(root)
    return jax.lax.platform_dependent(frames, local, cpu=loop, default=unrolled)


def com_pos(m: Model, frames: Float[Array, "F 3 4 N"]):
    """Compute `xmat`, `xipos` from the center of mass, `subtree_com`, `cdof` and `cinert`."""
    dtype, body = frames.dtype, frames[np.array([pose.frame for pose in m.bodies[1:]])]
    xmat, mass = body[:, :, :3], constant(m.mj.body_mass[1:, None], dtype)
    ipos = constant(np.array([pose.pos for pose in m.inertial]), dtype)
    xipos = body[:, :, 3] + matvec(xmat, ipos)
    subtree_com = jnp.sum(mass * xipos, 0) / m.mj.body_mass.sum()
    cdof, offset = _cdof(m, frames, subtree_com), xipos - subtree_com
    inertia = zip(m.inertial, m.mj.body_inertia[1:], strict=True)
    local = constant(np.array([pose.mat * i @ pose.mat.T for pose, i in inertia]), dtype)
    turned = matmul(matmul(xmat, local), jnp.swapaxes(xmat, 1, 2))
    square = dot(offset, offset)[:, None, None] * constant(np.eye(3), dtype)
    outer = offset[:, :, None] * offset[:, None]
    steiner = constant(m.mj.body_mass[1:, None, None], dtype) * (square - outer)
    return xmat, offset, subtree_com, cdof, Inertia(turned + steiner, mass * offset, mass)


def _cdof(m: Model, frames: Array, subtree_com: Array) -> Array:
    dtype, joints = frames.dtype, np.arange(int(m.has_free_root), m.mj.njnt)
    slides = constant(m.mj.jnt_type[joints, None] == SLIDE, dtype)
    mat, pos = frames[1:, :, :3], frames[1:, :, 3]
    axis = matvec(mat, constant(m.mj.jnt_axis[joints], dtype))
    anchor = pos + matvec(mat, constant(m.mj.jnt_pos[joints], dtype))
    angular = (1 - slides) * axis
    linear = slides * axis + cross(angular, subtree_com - anchor)
    cdof = jnp.concatenate([angular, linear], 1)
    if not m.has_free_root:
        return cdof
    eye = constant(np.eye(3), dtype) + 0 * subtree_com[0]
    axes = jnp.swapaxes(frames[0, :, :3], 0, 1)
    translate = jnp.concatenate([0 * eye, eye], 1)
    rotate = jnp.concatenate([axes, cross(axes, subtree_com - frames[0, :, 3])], 1)
    return jnp.concatenate([translate, rotate, cdof])


def com_vel(m: Model, cdof: Array, qvel: Array) -> tuple[Array, Array]:
    """Compute `cvel` and the acceleration of each body at `qacc` = 0, gravity included."""
    motion = cdof * qvel[:, None]
    sums = masked_sum(np.concatenate([m.body_dofs, m.dof_ancestors]), motion)
    cvel, dof_vel = jnp.split(sums, [len(m.body_dofs)])
    gravity = constant(np.r_[np.zeros(3), m.mj.opt.gravity], cdof.dtype)
    return cvel, masked_sum(m.body_dofs, math.motion_cross(dof_vel, motion)) - gravity


def crb_rne(m: Model, cdof: Array, cinert: Inertia, cfrc: Array) -> tuple[Array, Array]:
    """Compute `qM` from composite rigid bodies, and `qfrc_bias` from the forces on the bodies.

    Both are sums over the bodies that a degree of freedom moves, taken in one product.
    """
    flat = cinert.rotational.reshape(len(cfrc), 9, -1)
    moved = masked_sum(m.body_dofs.T, jnp.concatenate([flat, cinert.moment, cfrc], 1))
    mass = constant((m.body_dofs.T @ m.mj.body_mass[1:])[:, None], cdof.dtype)
    crb = Inertia(moved[:, :9].reshape(-1, 3, 3, cdof.shape[-1]), moved[:, 9:12], mass)
    qfrc_bias = dot(cdof, moved[:, 12:])
    momentum = math.inert_mul(crb, cdof)
    # entry i, j ≤ i: the motion of j on the momentum of all that i moves
    half = sum(momentum[:, None, k] * cdof[None, :, k] for k in range(6))
    related = (m.body_dofs[m.mj.dof_bodyid - 1] * np.tri(m.mj.nv))[..., None] > 0
    upper = jnp.where(np.swapaxes(related, 0, 1), jnp.swapaxes(half, 0, 1), 0)
    armature = constant(np.diag(m.mj.dof_armature), cdof.dtype)
    return jnp.where(related, half, upper) + armature, qfrc_bias


def _applied(m: Model, qpos: Array, qvel: Array, ctrl: Array) -> Array:
    """Return `qfrc_actuator` and the springs and dampers of `qfrc_passive`."""
    mj, dtype = m.mj, qpos.dtype
    unlimited = [-np.inf, np.inf]
    ctrlrange = np.where(mj.actuator_ctrllimited[:, None], mj.actuator_ctrlrange, unlimited)
    low, high = (constant(x, dtype) for x in ctrlrange.T)
    force = masked_sum(m.actuator_moment, jnp.clip(ctrl, low, high))
    force = force - constant(mj.dof_damping, dtype) * qvel
    if mj.jnt_stiffness.any():
        joint, address = mj.dof_jntid, mj.jnt_qposadr[mj.dof_jntid]
        stretch = qpos[address] - constant(mj.qpos_spring[address], dtype)
        force -= constant(mj.jnt_stiffness[joint], dtype) * stretch
    return force


def _inertia_box_fluid_model(m: Model, xmat: Array, offset: Array, cvel: Array) -> Array:
    """Return drag and viscosity on each body as on the box of its inertia."""
    mass, inertia, dtype = m.mj.body_mass[1:, None], m.mj.body_inertia[1:], cvel.dtype
    viscosity, density = m.mj.opt.viscosity, m.mj.opt.density
    ximat = matmul(xmat, constant(np.array([pose.mat for pose in m.inertial]), dtype))
    square = np.maximum(inertia.sum(1, keepdims=True) - 2 * inertia, mujoco.mjMINVAL) / mass
    box = np.sqrt(6 * square)
    x, y, z = box.T
    area = np.stack([y * z, x * z, x * y], 1)
    spin = np.stack([x * (y**4 + z**4), y * (x**4 + z**4), z * (x**4 + y**4)], 1)
    diameter = box.mean(1, keepdims=True)

    def resist(velocity, linear, quadratic):
        local = matvec(jnp.swapaxes(ximat, 1, 2), velocity)
        drag = constant(linear, dtype) + constant(quadratic, dtype) * jnp.abs(local)
        return matvec(ximat, -local * drag)

    angular, linear = cvel[:, :3], cvel[:, 3:]
    torque = resist(angular, np.pi * viscosity * diameter**3, density * spin / 64)
    linear = linear + cross(angular, offset)
    force = resist(linear, 3 * np.pi * viscosity * diameter, density * area / 2)
    return jnp.concatenate([torque + cross(offset, force), force], 1)
