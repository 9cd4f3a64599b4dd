"""Constants of a model, read once; anything that the engine does not compute is refused by name."""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Array

FREE, SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
PLANE, CAPSULE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)

Constants = np.ndarray | Array
"""Constants of the model; arrays of JAX where each env keeps other contacts."""


class Pose(NamedTuple):
    """A constant pose in the frame of a joint; frame 0 is the world frame or the free root."""

    frame: int
    pos: np.ndarray
    mat: np.ndarray

    def at(self, pos: np.ndarray, quat: np.ndarray) -> "Pose":
        """Return the pose that is given relative to this one."""
        return Pose(self.frame, self.pos + self.mat @ pos, self.mat @ quat_to_mat(quat))


class SolverParams(NamedTuple):
    """Solver parameters of K limits or contacts.

    `k` and `b` are stiffness and damping of the reference acceleration, `solimp` is clipped.
    """

    margin: Constants
    """[K] the constraint is active below this distance [m, rad]."""
    invweight: Constants
    """[K] `efc_diagApprox`: approximate inverse inertia along the row [1/kg, 1/(kg m²)]."""
    k: Constants
    b: Constants
    solimp: Constants
    """[K 5] d_0, d_width, width, midpoint, power."""

    @classmethod
    def create(cls, mj: mujoco.MjModel, margin, invweight, solref, solimp) -> "SolverParams":
        """Read `solref`: time constant and damping ratio or, if negative, k and b."""
        low, high, width, midpoint, power = solimp.T
        limits = mujoco.mjMINIMP, mujoco.mjMAXIMP
        low, high, midpoint = (np.clip(x, *limits) for x in (low, high, midpoint))
        timeconst, dampratio = solref.T
        safe = np.maximum(timeconst, 2 * mj.opt.timestep)
        k = np.where(timeconst > 0, 1 / (high * safe * dampratio) ** 2, -timeconst / high**2)
        b = np.where(dampratio > 0, 2 / (high * safe), -dampratio / high)
        width, power = np.maximum(width, mujoco.mjMINVAL), np.maximum(power, 1)
        return cls(margin, invweight, k, b, np.stack([low, high, width, midpoint, power], 1))


class Model(NamedTuple):
    """One tree of J hinges and slides, possibly with a free root.

    F = J + 1 frames, B moving bodies, V degrees of freedom, U motors.
    """

    mj: mujoco.MjModel
    has_free_root: bool
    """True if 7 positions and 6 velocities of a free joint come first."""
    bodies: list[Pose]
    """Body frames, the world body included."""
    inertial: list[Pose]
    """Inertial frames (`body_ipos`, `body_iquat`) of the moving bodies."""
    joint_parent: np.ndarray
    """[J] frame that the joint hangs on; the joint's own frame is its number plus one."""
    joint_terms: np.ndarray
    """[J 4 3 4] pose in the parent's frame: A₀ + A₁ sin q + A₂ (1 − cos q) + A₃ q."""
    body_dofs: np.ndarray
    """[B V] 1 where a degree of freedom moves a body."""
    dof_ancestors: np.ndarray
    """[V V] 1 where the second degree of freedom moves the axis of the first."""
    actuator_moment: np.ndarray
    """[V U] force per unit of control."""


def quat_to_mat(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a unit quaternion."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, float))
    return out.reshape(3, 3)


def put_model(model: mujoco.MjModel) -> Model:
    """Read the constants of a model.

    Raises:
        ValueError: if the model has something that this engine does not compute.
    """
    _refuse_uncovered(model)
    bodies, parents, terms = [Pose(0, np.zeros(3), np.eye(3))], [], []
    dofs = np.zeros((model.nbody, model.nv))
    for body in range(1, model.nbody):
        parent, first = model.body_parentid[body], model.body_jntadr[body]
        pose = bodies[parent].at(model.body_pos[body], model.body_quat[body])
        for joint in range(first, first + model.body_jntnum[body]):
            if model.jnt_type[joint] != FREE:
                parents.append(pose.frame)
                terms.append(_joint_terms(model, joint, pose))
            pose = Pose(len(parents), np.zeros(3), np.eye(3))
        bodies.append(pose)
        dofs[body] = dofs[parent]
        dofs[body, model.body_dofadr[body] + np.arange(model.body_dofnum[body])] = 1
    free = bool(model.jnt_type[0] == FREE)
    ancestors = dofs[model.dof_bodyid] * np.tri(model.nv, k=-1)
    if free:
        ancestors[3:6, 3:6] = 0  # the three rotations are one joint
    moment, gain = np.zeros((model.nv, model.nu)), model.actuator_gainprm[:, 0]
    dof = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    moment[dof, np.arange(model.nu)] = model.actuator_gear[:, 0] * gain
    inertial = [p.at(model.body_ipos[i], model.body_iquat[i]) for i, p in enumerate(bodies)][1:]
    parents, terms = np.array(parents, int), np.reshape(terms, (-1, 4, 3, 4))
    return Model(model, free, bodies, inertial, parents, terms, dofs[1:], ancestors, moment)


def _joint_terms(model: mujoco.MjModel, joint: int, pose: Pose) -> np.ndarray:
    """Return `Model.joint_terms` of a joint: for a hinge Rodrigues' formula about its anchor."""
    axis, terms = model.jnt_axis[joint], np.zeros((4, 3, 4))
    terms[0] = np.c_[pose.mat, pose.pos]
    if model.jnt_type[joint] == SLIDE:
        terms[3, :, 3] = pose.mat @ axis
    else:
        skew = np.cross(np.eye(3), axis)
        terms[1, :, :3], terms[2, :, :3] = pose.mat @ skew, pose.mat @ skew @ skew
        terms[1:3, :, 3] = -terms[1:3, :, :3] @ model.jnt_pos[joint]
    return terms


_ZERO = (
    "na", "neq", "ntendon", "npair", "nexclude", "body_gravcomp", "jnt_actfrclimited",
    "jnt_stiffnesspoly", "dof_frictionloss", "dof_dampingpoly", "actuator_forcelimited",
    "actuator_armature", "actuator_damping", "actuator_dampingpoly", "actuator_delay",
)  # fmt: skip
"""Fields of `mjModel` that are zero in every model that the engine covers."""


def _refuse_uncovered(m: mujoco.MjModel) -> None:
    joint, geom, opt = mujoco.mjtJoint, mujoco.mjtGeom, m.opt
    free, root = m.jnt_type == FREE, np.arange(m.njnt) == 0
    simple = np.isin(m.jnt_type, [SLIDE, int(joint.mjJNT_HINGE)]) | root & free
    collides = (m.geom_contype | m.geom_conaffinity) > 0
    moving = m.body_weldid[m.geom_bodyid] != 0
    round_geom = np.isin(m.geom_type, [int(geom.mjGEOM_SPHERE), CAPSULE]) & moving
    shaped = np.where(m.geom_bodyid == 0, m.geom_type == PLANE, round_geom)
    motor = (
        (m.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
        & ~free[np.minimum(m.actuator_trnid[:, 0], m.njnt - 1)]
        & (m.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED))
        & (m.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE))
    )
    integrator, rk4 = mujoco.mjtIntegrator(opt.integrator), mujoco.mjtIntegrator.mjINT_RK4
    overlap = 2 * m.jnt_margin > np.ptp(m.jnt_range, axis=1)
    fluid, flags = opt.density + opt.viscosity > 0, opt.disableflags | opt.enableflags
    mixing = m.geom_priority, m.geom_solmix
    reasons = {
        f"integrator {integrator.name}": integrator != rk4,
        "ball joints, or free joints below the root": ~simple,
        "springs at free joints": m.jnt_stiffness[free],
        "more than one tree": m.body_rootid[1:] != 1,
        "actuators other than motors at hinges and slides": ~motor,
        "elliptic friction cones": opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "torsional friction": collides & (m.geom_condim > 3),
        "contacts without friction": collides & (m.geom_friction[:, 0] < mujoco.mjMINMU),
        "joint limits with margins that overlap": (m.jnt_limited > 0) & overlap,
        "bodies without mass in a fluid": fluid & (m.body_mass[1:] < mujoco.mjMINVAL),
        "colliding geoms other than spheres and capsules over planes": collides & ~shaped,
        "contact softness given as stiffness and damping": collides[:, None] & (m.geom_solref <= 0),
        "geoms of different priority or weight": [np.ptp(x) for x in mixing if len(x)],
        "wind": opt.wind,
        "the ellipsoid fluid model": m.geom_fluid[:, 0],
        "option flags other than the default": flags | opt.disableactuator,
    }
    reasons |= {name: getattr(m, name) for name in _ZERO}
    found = [reason for reason, present in reasons.items() if np.any(present)]
    if found:
        raise ValueError(f"physics jax does not cover {', '.join(found)}, which the model has")
