"""A kinematic tree without constraints: its pose, mass matrix and smooth acceleration.

MuJoCo's quantities by MuJoCo's conventions: 6-vectors are rotation before translation, taken about the tree's centre of
mass. A sum over ancestors or descendants is one product with a constant matrix of zeros and ones.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from dgae_jax.physics.jax.spatial import apply, compose, constant, cross, dot, rotation, total

_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)


class Attachment(NamedTuple):
    """A constant pose in a joint's frame; frame 0 is the root's: the world, or the floating torso."""

    frame: int
    position: np.ndarray
    rotation: np.ndarray

    def at(self, position: np.ndarray, quat: np.ndarray) -> "Attachment":
        """A pose given relative to this one."""
        return Attachment(
            self.frame, self.position + self.rotation @ position, self.rotation @ quat_matrix(quat)
        )


class Tree(NamedTuple):
    """The constants of a model with F frames, J hinges and slides, B moving bodies, V degrees of freedom and U motors."""

    model: mujoco.MjModel
    floating: bool
    """Whether the root is a free joint; its 7 positions and 6 velocities come first."""
    bodies: list[Attachment]
    """Of every body, the world included."""
    parents: np.ndarray
    """[J] frame of each joint's parent; the joint's own frame is its number plus one."""
    forms: np.ndarray
    """[J 4 3 4] the pose of a joint's frame in its parent's is A₀ + A₁ sin q + A₂ (1 − cos q) + A₃ q."""
    moves: np.ndarray
    """[B V] 1 where a degree of freedom moves a body."""
    before: np.ndarray
    """[V V] 1 where the second degree of freedom moves the axis of the first."""
    gear: np.ndarray
    """[V U] force per unit of control."""


class Smooth(NamedTuple):
    """The dynamics before constraints."""

    frames: Float[Array, "F 3 4 W"]
    """Rotation and position of each joint's frame, `xmat` and `xpos` of the body behind the joint."""
    centre: Float[Array, "3 W"]
    """Centre of mass, `subtree_com` of the root [m]."""
    axes: Float[Array, "V 6 W"]
    """How a unit of each velocity moves the tree, `cdof`."""
    mass: Float[Array, "V V W"]
    """`qM` in full."""
    force: Float[Array, "V W"]
    """`qfrc_smooth`: motors, springs, dampers, gravity, fluid and bias [N, N m]."""


def quat_matrix(quat: np.ndarray) -> np.ndarray:
    """The rotation matrix of a unit quaternion."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, float))
    return out.reshape(3, 3)


def tree_of(model: mujoco.MjModel) -> Tree:
    """Read the constants of a model: one tree of hinges and slides, whose root may float."""
    floating = bool(model.jnt_type[0] == _FREE)
    bodies = [Attachment(0, np.zeros(3), np.eye(3))]
    moves, parents, forms = np.zeros((model.nbody, model.nv)), [], []
    for body in range(1, model.nbody):
        here = bodies[model.body_parentid[body]].at(model.body_pos[body], model.body_quat[body])
        for joint in range(
            model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]
        ):
            if model.jnt_type[joint] != _FREE:
                parents.append(here.frame)
                forms.append(_form(model, joint, here))
            here = Attachment(len(parents), np.zeros(3), np.eye(3))
        bodies.append(here)
        moves[body] = moves[model.body_parentid[body]]
        moves[body, model.body_dofadr[body] + np.arange(model.body_dofnum[body])] = 1
    before = moves[model.dof_bodyid] * np.tri(model.nv, k=-1)
    if floating:
        before[3:6, 3:6] = 0  # the three rotations are one joint
    gear = np.zeros((model.nv, model.nu))
    gear[model.jnt_dofadr[model.actuator_trnid[:, 0]], np.arange(model.nu)] = (
        model.actuator_gear[:, 0] * model.actuator_gainprm[:, 0]
    )
    return Tree(
        model,
        floating,
        bodies,
        np.array(parents, int),
        np.reshape(forms, (-1, 4, 3, 4)),
        moves[1:],
        before,
        gear,
    )


def _form(model: mujoco.MjModel, joint: int, here: Attachment) -> np.ndarray:
    """The four matrices of a joint's pose: for a hinge Rodrigues' formula about its anchor."""
    axis, form = model.jnt_axis[joint], np.zeros((4, 3, 4))
    form[0] = np.c_[here.rotation, here.position]
    if model.jnt_type[joint] == _SLIDE:
        form[3, :, 3] = here.rotation @ axis
    else:
        skew = np.cross(np.eye(3), axis)
        form[1, :, :3], form[2, :, :3] = here.rotation @ skew, here.rotation @ skew @ skew
        form[1:3, :, 3] = -form[1:3, :, :3] @ model.jnt_pos[joint]
    return form


def frames_of(tree: Tree, qpos: Float[Array, "Q W"]) -> Float[Array, "F 3 4 W"]:
    """Forward kinematics: rotation and position of the root's frame and of each joint's, behind the joint."""
    model, joints = tree.model, np.arange(int(tree.floating), tree.model.njnt)
    angle = qpos[model.jnt_qposadr[joints]] - constant(
        model.qpos0[model.jnt_qposadr[joints]], qpos.dtype
    )
    terms = (jnp.sin(angle), 1 - jnp.cos(angle), angle)
    local = constant(tree.forms[:, 0], qpos.dtype)
    local += sum(
        constant(tree.forms[:, i + 1], qpos.dtype) * x[:, None, None] for i, x in enumerate(terms)
    )
    root = constant(np.eye(3, 4), qpos.dtype) + 0 * qpos[0]
    if tree.floating:
        root = jnp.concatenate([rotation(qpos[3:7]), qpos[:3, None]], 1)

    def hang(frames, joint):
        number, parent, pose = joint
        pose = jnp.concatenate([pose, constant(np.eye(4)[3:], qpos.dtype) + 0 * pose[:1]])
        return frames.at[number].set(compose(frames[parent], pose)), None

    def in_a_loop(frames, local):
        return jax.lax.scan(
            hang, frames, (jnp.arange(len(joints)) + 1, jnp.asarray(tree.parents), local)
        )[0]

    def written_out(frames, local):  # an accelerator pays a launch for each turn of a loop
        for joint in range(len(joints)):
            frames, _ = hang(frames, (joint + 1, int(tree.parents[joint]), local[joint]))
        return frames

    frames = jnp.zeros((len(joints) + 1, *root.shape), qpos.dtype).at[0].set(root)
    return jax.lax.platform_dependent(frames, local, cpu=in_a_loop, default=written_out)


def smooth(
    tree: Tree, qpos: Float[Array, "Q W"], qvel: Float[Array, "V W"], ctrl: Float[Array, "U W"]
) -> Smooth:
    """Everything but constraints; the bias force by the recursive Newton–Euler equations, written with sums over the tree."""
    model, dtype = tree.model, qpos.dtype
    frames = frames_of(tree, qpos)
    here = frames[np.array([b.frame for b in tree.bodies[1:]])]
    turn = here[:, :, :3]
    inertial = [b.at(model.body_ipos[i], model.body_iquat[i]) for i, b in enumerate(tree.bodies)][
        1:
    ]
    mass = constant(model.body_mass[1:, None], dtype)
    com = here[:, :, 3] + apply(turn, constant(np.array([b.position for b in inertial]), dtype))
    centre = jnp.sum(mass * com, 0) / model.body_mass.sum()
    axes = _axes(tree, frames, centre)

    arm = com - centre
    inertia, moment = _inertia(tree, turn, inertial, arm), mass * arm
    moving = axes * qvel[:, None]
    velocity, carrier = jnp.split(
        total(np.concatenate([tree.moves, tree.before]), moving), [len(com)]
    )
    acceleration = total(tree.moves, _motion_cross(carrier, moving)) - constant(
        np.r_[np.zeros(3), model.opt.gravity], dtype
    )
    force = _momentum(inertia, moment, mass, acceleration) + _force_cross(
        velocity, _momentum(inertia, moment, mass, velocity)
    )
    if model.opt.density > 0 or model.opt.viscosity > 0:
        force = force - _fluid(
            model,
            compose(turn, constant(np.array([b.rotation for b in inertial]), dtype)),
            arm,
            velocity,
        )

    beyond = jnp.concatenate([inertia.reshape(len(com), 9, -1), moment, force], 1)
    beyond = total(tree.moves.T, beyond)
    whole = (
        beyond[:, :9].reshape(-1, 3, 3, qpos.shape[-1]),
        beyond[:, 9:12],
        constant((tree.moves.T @ model.body_mass[1:])[:, None], dtype),
    )
    bias = dot(axes, beyond[:, 12:])
    return Smooth(
        frames,
        centre,
        axes,
        _mass_matrix(tree, axes, _momentum(*whole, axes)),
        _applied(tree, qpos, qvel, ctrl) - bias,
    )


def _axes(tree: Tree, frames: Array, centre: Array) -> Array:
    model, dtype, joints = tree.model, frames.dtype, np.arange(int(tree.floating), tree.model.njnt)
    slides = constant(model.jnt_type[joints, None] == _SLIDE, dtype)
    turn, position = frames[1:, :, :3], frames[1:, :, 3]
    axis = apply(turn, constant(model.jnt_axis[joints], dtype))
    anchor = position + apply(turn, constant(model.jnt_pos[joints], dtype))
    angular = (1 - slides) * axis
    axes = jnp.concatenate([angular, slides * axis + cross(angular, centre - anchor)], 1)
    if not tree.floating:
        return axes
    eye, turn = constant(np.eye(3), dtype) + 0 * centre[0], jnp.swapaxes(frames[0, :, :3], 0, 1)
    translate = jnp.concatenate([0 * eye, eye], 1)
    rotate = jnp.concatenate([turn, cross(turn, centre - frames[0, :, 3])], 1)
    return jnp.concatenate([translate, rotate, axes])


def _inertia(tree: Tree, turn: Array, inertial: list[Attachment], arm: Array) -> Array:
    """Of each body about the tree's centre of mass, in world orientation."""
    principal = tree.model.body_inertia[1:]
    local = np.array(
        [b.rotation * i @ b.rotation.T for b, i in zip(inertial, principal, strict=True)]
    )
    turned = compose(compose(turn, constant(local, arm.dtype)), jnp.swapaxes(turn, 1, 2))
    square = dot(arm, arm)[:, None, None] * constant(np.eye(3), arm.dtype)
    return turned + constant(tree.model.body_mass[1:, None, None], arm.dtype) * (
        square - arm[:, :, None] * arm[:, None]
    )


def _momentum(inertia: Array, moment: Array, mass: Array, motion: Array) -> Array:
    """Spatial inertia times a motion."""
    angular, linear = motion[:, :3], motion[:, 3:]
    return jnp.concatenate(
        [apply(inertia, angular) + cross(moment, linear), mass * linear + cross(angular, moment)], 1
    )


def _motion_cross(velocity: Array, motion: Array) -> Array:
    """The rate of a motion vector carried along."""
    turning = cross(velocity[:, :3], motion[:, :3])
    return jnp.concatenate(
        [turning, cross(velocity[:, :3], motion[:, 3:]) + cross(velocity[:, 3:], motion[:, :3])], 1
    )


def _force_cross(velocity: Array, force: Array) -> Array:
    """The rate of a force or momentum carried along."""
    turning = cross(velocity[:, :3], force[:, :3]) + cross(velocity[:, 3:], force[:, 3:])
    return jnp.concatenate([turning, cross(velocity[:, :3], force[:, 3:])], 1)


def _mass_matrix(tree: Tree, axes: Array, momenta: Array) -> Array:
    """By composite rigid bodies: entry i, j ≤ i is axis j on the momentum of all that i moves."""
    related = tree.moves[tree.model.dof_bodyid - 1] * np.tri(tree.model.nv)
    half = sum(momenta[:, None, k] * axes[None, :, k] for k in range(6))
    full = jnp.where(
        related[..., None] > 0,
        half,
        jnp.where(related.T[..., None] > 0, jnp.swapaxes(half, 0, 1), 0),
    )
    return full + constant(np.diag(tree.model.dof_armature), axes.dtype)


def _applied(tree: Tree, qpos: Array, qvel: Array, ctrl: Array) -> Array:
    """Motors, dampers and springs."""
    model, dtype = tree.model, qpos.dtype
    low, high = np.where(
        model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-np.inf, np.inf]
    ).T
    force = (
        total(tree.gear, jnp.clip(ctrl, constant(low, dtype), constant(high, dtype)))
        - constant(model.dof_damping, dtype) * qvel
    )
    if model.jnt_stiffness.any():
        address = model.jnt_qposadr[model.dof_jntid]
        force -= constant(model.jnt_stiffness[model.dof_jntid], dtype) * (
            qpos[address] - constant(model.qpos_spring[address], dtype)
        )
    return force


def _fluid(model: mujoco.MjModel, turn: Array, arm: Array, velocity: Array) -> Array:
    """Drag and viscosity on each body as on the box of its inertia (MuJoCo's inertia-box model)."""
    dtype, mass, inertia = arm.dtype, model.body_mass[1:, None], model.body_inertia[1:]
    box = np.sqrt(
        6 * np.maximum(inertia.sum(1, keepdims=True) - 2 * inertia, mujoco.mjMINVAL) / mass
    )
    x, y, z = box.T
    across = np.stack([y * z, x * z, x * y], 1)
    around = np.stack([x * (y**4 + z**4), y * (x**4 + z**4), z * (x**4 + y**4)], 1)
    size, viscosity, density = box.mean(1, keepdims=True), model.opt.viscosity, model.opt.density

    def resist(motion, linear, quadratic):
        motion = apply(jnp.swapaxes(turn, 1, 2), motion)
        return apply(
            turn, -motion * (constant(linear, dtype) + constant(quadratic, dtype) * jnp.abs(motion))
        )

    angular, linear = velocity[:, :3], velocity[:, 3:]
    torque = resist(angular, np.pi * viscosity * size**3, density * around / 64)
    force = resist(linear + cross(angular, arm), 3 * np.pi * viscosity * size, density * across / 2)
    return jnp.concatenate([torque + cross(arm, force), force], 1)
