"""Google DeepMind's MuJoCo MJX, unchanged, over its JAX code or over MuJoCo Warp.

It takes any model that MJX takes. docs/environments.md says where it differs from C MuJoCo (Ant).
"""

import contextlib
import io
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array

from dgae_jax.physics import engine
from dgae_jax.physics.engine import Physics, PhysicsState, Reads

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that Warp is not installed
    from mujoco import mjx as upstream


def mjx(spec: mujoco.MjSpec, frame_skip: int, reads: Reads) -> Physics:
    """Build MJX over its JAX code, on any device."""
    model, device_model = _compile(spec, "mjx", "jax")

    @jax.default_matmul_precision("highest")  # TF32 on GPUs is too coarse for dynamics
    def step(state: PhysicsState, ctrl: Array) -> PhysicsState:
        blank = upstream.make_data(model, impl="jax")
        data, cfrc_ext = _substeps(device_model, blank, state, ctrl, frame_skip), state.cfrc_ext
        if reads.cfrc_ext:
            cfrc_ext = upstream.rne_postconstraint(device_model, data)._impl.cfrc_ext
        xpos = data.xpos[1 : 1 + reads.xpos]
        return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, xpos, cfrc_ext)

    return Physics(model, step, "mjx", reads)


def mjx_warp(spec: mujoco.MjSpec, frame_skip: int, reads: Reads) -> Physics:
    """Build MJX over MuJoCo Warp, in float32, for NVIDIA GPUs; on a CPU it is slow.

    All envs share a buffer of contacts, sized by Warp's default per env; Warp reports an overflow.
    """
    import warp  # pyright: ignore[reportMissingImports]

    warp.config.log_level = warp.LOG_WARNING  # it announces itself and every kernel that it loads
    model, device_model = _compile(spec, "mjx-warp", "warp")
    forces = {"opt._impl.run_rne_postconstraint": reads.cfrc_ext}
    device_model: Any = device_model.tree_replace(forces)
    contacts = upstream.make_data(model, impl="warp")._impl.naconmax

    def batched_step(state: PhysicsState, ctrl: Array) -> PhysicsState:
        blank = upstream.make_data(model, impl="warp", naconmax=contacts * ctrl.shape[-1])

        def one(state: PhysicsState, ctrl: Array) -> PhysicsState:
            data = _substeps(device_model, blank, state, ctrl, frame_skip)
            cfrc_ext = data._impl.cfrc_ext if reads.cfrc_ext else state.cfrc_ext
            xpos = data.xpos[1 : 1 + reads.xpos]
            return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, xpos, cfrc_ext)

        single = jax.tree.map(lambda x: x.astype(jnp.float32), (state, ctrl))
        after = jax.vmap(one, -1, -1)(*single)
        return jax.tree.map(lambda new, old: new.astype(old.dtype), after, state)

    return Physics(model, engine.single_env(batched_step), "mjx-warp", reads)


def _compile(spec: mujoco.MjSpec, name: str, impl: str):
    """Return the model and MJX's model."""
    spec = spec.copy()
    for numeric in list(spec.numerics):  # MJX 3.17 takes the first for its own limit on contacts
        spec.delete(numeric)
    model = spec.compile()
    engine.refuse_hidden_state(model, name)
    try:
        return model, upstream.put_model(model, impl=impl)
    except NotImplementedError as reason:
        raise ValueError(f"physics {name} does not cover this model: {reason}") from None


def _substeps(
    model: upstream.Model, data: upstream.Data, state: PhysicsState, ctrl: Array, frame_skip: int
) -> upstream.Data:
    data = data.replace(
        qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart, ctrl=ctrl
    )
    return jax.lax.fori_loop(0, frame_skip, lambda _, data: upstream.step(model, data), data)
