"""MuJoCo in JAX, stepped so that it compiles fast: the forward dynamics appear once in the program.

`mjx.step` unrolls the four stages of RK4. Here they are one scan over the tableau inside the scan over substeps.
"""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx as mujoco_mjx

from dgae_jax.physics.base import Physics, PhysicsState

_STAGE = jnp.array([0.0, 0.5, 0.5, 1.0])
_WEIGHT = jnp.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])


def mjx(model: mujoco.MjModel, frame_skip: int) -> Physics:
    """MJX advancing one world; vmap it. RK4 models of slide and hinge joints without activations.

    Raises ValueError, naming the reason, for a model it does not cover.
    """
    _refuse_uncovered(model)
    on_device = mujoco_mjx.put_model(model)
    template = mujoco_mjx.make_data(on_device)
    h = model.opt.timestep

    def acceleration(qpos, qvel, ctrl, warmstart):
        data = template.replace(qpos=qpos, qvel=qvel, ctrl=ctrl, qacc_warmstart=warmstart)
        return mujoco_mjx.forward(on_device, data).qacc

    def substep(state: PhysicsState, ctrl) -> PhysicsState:
        q, v, warm = state

        def stage(carry, tableau):
            k_q, k_v, sum_q, sum_v = carry
            a, b = tableau
            k_v, k_q = acceleration(q + a * h * k_q, v + a * h * k_v, ctrl, warm), v + a * h * k_v
            return (k_q, k_v, sum_q + b * k_q, sum_v + b * k_v), None

        zero = jnp.zeros_like(v)
        (_, last, dq, dv), _ = jax.lax.scan(stage, (zero, zero, zero, zero), (_STAGE.astype(v.dtype), _WEIGHT.astype(v.dtype)))
        return PhysicsState(q + h * dq, v + h * dv, last)

    @jax.default_matmul_precision("highest")
    def step(state: PhysicsState, ctrl) -> PhysicsState:
        return jax.lax.scan(lambda s, _: (substep(s, ctrl), None), state, None, length=frame_skip)[0]

    return Physics(model, step, "mjx")


def _refuse_uncovered(model: mujoco.MjModel) -> None:
    covered = {mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE}
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4:
        raise ValueError(f"physics mjx integrates with RK4; the model asks for {mujoco.mjtIntegrator(model.opt.integrator).name}")
    if not set(model.jnt_type.tolist()) <= {int(j) for j in covered}:
        raise ValueError("physics mjx covers slide and hinge joints; the model has free or ball joints")
    if model.na:
        raise ValueError(f"physics mjx covers models without activations; the model has {model.na}")
