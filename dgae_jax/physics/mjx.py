"""MuJoCo in JAX, stepped so that it compiles fast, runs fast and agrees with C.

- The forward dynamics appear once in the program: RK4 is a scan over its tableau inside the scan over substeps.
- The constraint solver is `newton`: it reaches the optimum in a few steps, where MJX's own spends its time in a line search
  that vmap never cuts short.
- Two places where MJX 3.17 differs from C are put right: the tangent of a plane–capsule contact, which C always takes
  along the capsule's axis, and the rotation of a free joint, which C integrates with RKMK's correction since MuJoCo 4.
"""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx as mujoco_mjx

from dgae_jax.physics import newton
from dgae_jax.physics.base import Physics, PhysicsState, has_free_root

_STAGE = (0.0, 0.5, 0.5, 1.0)
_WEIGHT = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
_CORRECTS_ROTATION = int(mujoco.__version__.split(".")[0]) >= 4


def mjx(spec: mujoco.MjSpec, frame_skip: int, *, contact_forces: bool = False, max_contacts: int | None = None) -> Physics:
    """MJX advancing one world; vmap it. Raises ValueError, naming the reason, for a model it does not cover.

    `max_contacts` bounds the rows of the solver; the nearest contacts are kept.
    """
    model = _compile(spec, max_contacts)
    _refuse_uncovered(model)
    m = mujoco_mjx.put_model(model)
    template = mujoco_mjx.make_data(m)
    h, free = model.opt.timestep, has_free_root(model)

    def forward(guess, qpos, qvel, ctrl):
        data = template.replace(qpos=qpos, qvel=qvel, ctrl=ctrl, qacc_warmstart=guess)
        return _forward(m, data)

    def substep(state: PhysicsState, ctrl) -> PhysicsState:
        q, v = state.qpos, state.qvel

        def stage(carry, tableau):
            (k_q, k_v), (sum_q, sum_v), _ = carry
            a, b = tableau
            data = forward(k_v, _integrate(q, a * h * k_q, free), v + a * h * k_v, ctrl)
            rate = data.qvel
            if free and _CORRECTS_ROTATION:
                rate = rate.at[3:6].set(_inverse_exponential(a * h * k_q[3:6], rate[3:6]))
            seen = data.xpos[1, : state.torso.shape[0]], _contact(m, data) if contact_forces else state.contact
            return ((rate, data.qacc), (sum_q + b * rate, sum_v + b * data.qacc), seen), None

        # the first stage is at a = 0, so the accelerations before it only start the solver
        first, zero = (jnp.zeros_like(v), state.warmstart), (jnp.zeros_like(v), jnp.zeros_like(v))
        tableau = jnp.asarray(_STAGE, v.dtype), jnp.asarray(_WEIGHT, v.dtype)
        ((_, warmstart), (dq, dv), seen), _ = jax.lax.scan(stage, (first, zero, (state.torso, state.contact)), tableau)
        return PhysicsState(_integrate(q, h * dq, free), v + h * dv, warmstart, *seen)

    @jax.default_matmul_precision("highest")  # TF32 on GPUs is no physics
    def step(state: PhysicsState, ctrl) -> PhysicsState:
        return jax.lax.scan(lambda s, _: (substep(s, ctrl), None), state, None, length=frame_skip)[0]

    return Physics(model, step, "mjx", contact_forces)


def _forward(m: mujoco_mjx.Model, d: mujoco_mjx.Data) -> mujoco_mjx.Data:
    """`mjx.forward` from its public stages, with our contact frames and solver."""
    for stage in (mujoco_mjx.kinematics, mujoco_mjx.com_pos, mujoco_mjx.crb, mujoco_mjx.factor_m, mujoco_mjx.collision):
        d = stage(m, d)
    d = _align_contacts(m, d)
    for stage in (
        mujoco_mjx.make_constraint,
        mujoco_mjx.transmission,
        mujoco_mjx.fwd_velocity,
        mujoco_mjx.fwd_actuation,
        mujoco_mjx.fwd_acceleration,
    ):
        d = stage(m, d)
    rows = d._impl
    if rows.efc_J.size == 0:
        return d.replace(qacc=d.qacc_smooth)
    problem = newton.Problem(rows.M, d.qacc_smooth, d.qfrc_smooth, rows.efc_J.T, rows.efc_D, rows.efc_aref)
    solution = newton.solve(problem, d.qacc_warmstart)
    push = -rows.efc_D * jnp.minimum(solution.residual, 0)
    return d.tree_replace({"qacc": solution.acceleration, "_impl.efc_force": push})  # pyright: ignore[reportReturnType]


def _align_contacts(m: mujoco_mjx.Model, d: mujoco_mjx.Data) -> mujoco_mjx.Data:
    """The first tangent of every plane–capsule contact along the capsule's axis, as in C.

    MJX does so for flat capsules only, which turns the friction pyramid of steep ones.
    """
    if d._impl.ncon == 0:
        return d
    contact, types = d._impl.contact, jnp.asarray(m.geom_type)
    first, second = contact.geom[:, 0], contact.geom[:, 1]
    ours = (types[first] == int(mujoco.mjtGeom.mjGEOM_PLANE)) & (types[second] == int(mujoco.mjtGeom.mjGEOM_CAPSULE))
    normal, axis = contact.frame[:, 0], d.geom_xmat[second][..., 2]
    tangent = axis - normal * (normal * axis).sum(-1, keepdims=True)
    size = jnp.linalg.norm(tangent, axis=-1, keepdims=True)
    upright = size < 1e-6
    tangent = jnp.where(upright, contact.frame[:, 1], tangent / jnp.where(upright, 1, size))
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)], 1)
    return d.tree_replace({"_impl.contact.frame": jnp.where(ours[:, None, None], frame, contact.frame)})  # pyright: ignore[reportReturnType]


def _contact(m: mujoco_mjx.Model, d: mujoco_mjx.Data) -> jax.Array:
    return mujoco_mjx.rne_postconstraint(m, d)._impl.cfrc_ext


def _integrate(qpos: jax.Array, move: jax.Array, free: bool) -> jax.Array:
    """The position after a displacement in velocity coordinates."""
    if not free:
        return qpos + move
    turned = _rotate(qpos[3:7], move[3:6])
    return jnp.concatenate([qpos[:3] + move[:3], turned, qpos[7:] + move[6:]])


def _rotate(quat: jax.Array, rotation: jax.Array) -> jax.Array:
    """A unit quaternion turned by a rotation vector in its own frame."""
    angle = jnp.linalg.norm(rotation)
    axis = rotation / jnp.where(angle > 0, angle, 1)
    w, xyz = jnp.cos(angle / 2), jnp.sin(angle / 2) * axis
    q = quat / jnp.linalg.norm(quat)
    turned = jnp.concatenate([(q[0] * w - jnp.dot(q[1:], xyz))[None], q[0] * xyz + w * q[1:] + jnp.cross(q[1:], xyz)])
    return turned / jnp.linalg.norm(turned)


def _inverse_exponential(theta: jax.Array, omega: jax.Array) -> jax.Array:
    """dexp⁻¹: the rate of a rotation vector θ while the body turns at ω, to fourth order (Munthe-Kaas 1998)."""
    once = jnp.cross(theta, omega)
    return omega + 0.5 * once + jnp.cross(theta, once) / 12


def _compile(spec: mujoco.MjSpec, max_contacts: int | None) -> mujoco.MjModel:
    """The model with its contact limit as MJX reads it: the only numeric, since MJX 3.17 looks at its data by number."""
    spec = spec.copy()
    for numeric in list(spec.numerics):
        spec.delete(numeric)
    if max_contacts is not None:
        spec.add_numeric(name="max_contact_points", data=[max_contacts], size=1)
    return spec.compile()


def _refuse_uncovered(model: mujoco.MjModel) -> None:
    joints = set(model.jnt_type[1:].tolist()) | (set() if has_free_root(model) else {int(model.jnt_type[0])})
    plain = {int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)}
    reasons = {
        f"integrator {mujoco.mjtIntegrator(model.opt.integrator).name}": model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4,
        "ball joints, or free joints below the root": not joints <= plain,
        "activations": model.na > 0,
        "equality constraints": model.neq > 0,
        "friction loss": (model.dof_frictionloss > 0).any() or (model.tendon_frictionloss > 0).any(),
        "elliptic friction cones": model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "tendons": model.ntendon > 0,
        "a sparse mass matrix": model.nv >= 60,
    }
    found = [reason for reason, present in reasons.items() if present]
    if found:
        raise ValueError(f"physics mjx does not cover {', '.join(found)}, which the model has")
