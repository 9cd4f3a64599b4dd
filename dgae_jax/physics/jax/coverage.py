"""What our MuJoCo in JAX covers: anything else in a model is refused by name, never computed wrongly."""

import mujoco
import numpy as np

_NEWER = (
    "jnt_stiffnesspoly",
    "dof_dampingpoly",
    "actuator_armature",
    "actuator_damping",
    "actuator_dampingpoly",
    "actuator_delay",
)
"""Fields that newer versions of MuJoCo have, all zero in a plain model."""


def refuse_uncovered(model: mujoco.MjModel) -> None:
    """Raise ValueError, naming the reasons, for a model with something that our engine does not compute."""
    found = [reason for reason, present in _reasons(model).items() if np.any(present)]
    if found:
        raise ValueError(f"physics jax does not cover {', '.join(found)}, which the model has")


def _reasons(model: mujoco.MjModel) -> dict[str, bool | np.bool_ | np.ndarray]:
    joint, geom = mujoco.mjtJoint, mujoco.mjtGeom
    root = np.arange(model.njnt) == 0
    plain = np.isin(model.jnt_type, [int(joint.mjJNT_SLIDE), int(joint.mjJNT_HINGE)]) | root & (
        model.jnt_type == int(joint.mjJNT_FREE)
    )
    world, collides = model.geom_bodyid == 0, (model.geom_contype | model.geom_conaffinity) > 0
    round_ = np.isin(model.geom_type, [int(geom.mjGEOM_SPHERE), int(geom.mjGEOM_CAPSULE)])
    shapes = np.where(
        world,
        model.geom_type == int(geom.mjGEOM_PLANE),
        round_ & (model.body_weldid[model.geom_bodyid] != 0),
    )
    motor = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)) & (
        model.jnt_type[np.minimum(model.actuator_trnid[:, 0], model.njnt - 1)]
        != int(joint.mjJNT_FREE)
    )
    motor &= (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)) & (
        model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE)
    )
    return {
        f"integrator {mujoco.mjtIntegrator(model.opt.integrator).name}": model.opt.integrator
        != mujoco.mjtIntegrator.mjINT_RK4,
        "ball joints, or free joints below the root": ~plain,
        "springs at free joints": model.jnt_stiffness[model.jnt_type == int(joint.mjJNT_FREE)] != 0,
        "more than one tree": model.body_rootid[1:] != 1,
        "activations": model.na > 0,
        "actuators other than motors at hinges and slides": ~motor,
        "limits on forces": np.r_[model.actuator_forcelimited, model.jnt_actfrclimited],
        "equality constraints": model.neq > 0,
        "tendons": model.ntendon > 0,
        "friction loss": model.dof_frictionloss > 0,
        "elliptic friction cones": model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "torsional friction": collides & (model.geom_condim > 3),
        "contacts without friction": collides & (model.geom_friction[:, 0] < mujoco.mjMINMU),
        "joint limits with margins that overlap": (model.jnt_limited > 0)
        & (2 * model.jnt_margin > np.ptp(model.jnt_range, axis=1)),
        "bodies without mass in a fluid": (model.body_mass[1:] < mujoco.mjMINVAL)
        & (model.opt.density + model.opt.viscosity > 0),
        "contact pairs or exclusions": model.npair + model.nexclude > 0,
        "colliding geoms other than spheres and capsules over planes": collides & ~shapes,
        "contact softness given as stiffness and damping": collides[:, None]
        & (model.geom_solref <= 0),
        "geoms of different priority or weight": (model.geom_priority != model.geom_priority[:1])
        | (model.geom_solmix != model.geom_solmix[:1]),
        "gravity compensation": model.body_gravcomp != 0,
        "wind": model.opt.wind != 0,
        "the ellipsoid fluid model": model.geom_fluid[:, 0] != 0,
        "option flags other than the default": model.opt.disableflags
        | model.opt.enableflags
        | model.opt.disableactuator,
        **{
            name.replace("_", " "): getattr(model, name) != 0
            for name in _NEWER
            if hasattr(model, name)
        },
    }
