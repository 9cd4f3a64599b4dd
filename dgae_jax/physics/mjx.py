"""Google DeepMind's MuJoCo MJX, unchanged: `put_model`, `make_data`, `step` over its JAX code or over MuJoCo Warp.

It takes any model that MJX takes. Where it differs from C MuJoCo, for Ant, is in docs/environments.md.
"""

import contextlib
import io
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array

from dgae_jax.physics.engine import Physics, PhysicsState, Reads, body_ids, refuse_hidden_state
from dgae_jax.physics.worlds import of_one_world

with contextlib.redirect_stdout(
    io.StringIO()
):  # MJX prints that it has no Warp, which is no news here
    from mujoco import mjx as upstream


def mjx(spec: mujoco.MjSpec, frame_skip: int, reads: Reads) -> Physics:
    """MJX's JAX code, on any device. Raises ValueError, naming the reason, for a model that MJX does not cover."""
    model, bodies = _compiled(spec, reads, "mjx")
    device_model = _put(model, "jax", "mjx")

    @jax.default_matmul_precision("highest")  # TF32 on GPUs is too coarse for dynamics
    def step(state: PhysicsState, ctrl: Array) -> PhysicsState:
        data = _advance(
            device_model, upstream.make_data(model, impl="jax"), state, ctrl, frame_skip
        )
        forces = (
            upstream.rne_postconstraint(device_model, data)._impl.cfrc_ext
            if reads.forces
            else state.cfrc_ext
        )
        return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, data.xpos[bodies], forces)

    return Physics(model, step, "mjx", reads)


def mjx_warp(spec: mujoco.MjSpec, frame_skip: int, reads: Reads) -> Physics:
    """MJX over MuJoCo Warp, always in float32: for NVIDIA GPUs; it runs on CPUs too, one thread, slowly.

    Its buffer of contacts is shared by all worlds and sized for their number, at MuJoCo Warp's own default per world; Warp
    says so if that ever overflows. Raises ValueError, naming the reason, for a model that it does not cover.
    """
    import warp  # pyright: ignore[reportMissingImports]

    warp.config.log_level = warp.LOG_WARNING  # it announces itself and every kernel that it loads
    model, bodies = _compiled(spec, reads, "mjx-warp")
    device_model: Any = _put(model, "warp", "mjx-warp").tree_replace(
        {"opt._impl.run_rne_postconstraint": reads.forces}
    )
    contacts = upstream.make_data(model, impl="warp")._impl.naconmax

    def advance(state: PhysicsState, ctrl: Array) -> PhysicsState:
        blank = upstream.make_data(model, impl="warp", naconmax=contacts * ctrl.shape[-1])

        def one(state: PhysicsState, ctrl: Array) -> PhysicsState:
            data = _advance(device_model, blank, state, ctrl, frame_skip)
            forces = data._impl.cfrc_ext if reads.forces else state.cfrc_ext
            return PhysicsState(
                data.qpos, data.qvel, data.qacc_warmstart, data.xpos[bodies], forces
            )

        single = jax.tree.map(lambda x: x.astype(jnp.float32), (state, ctrl))
        after = jax.vmap(one, -1, -1)(*single)
        return jax.tree.map(lambda new, old: new.astype(old.dtype), after, state)

    return Physics(model, of_one_world(advance), "mjx-warp", reads)


def _compiled(spec: mujoco.MjSpec, reads: Reads, name: str):
    """The model and the bodies to read. MJX 3.17 takes the first `numeric` element for its own limit on contacts: leave them out."""
    spec = spec.copy()
    for numeric in list(spec.numerics):
        spec.delete(numeric)
    model = spec.compile()
    refuse_hidden_state(model, name)
    return model, body_ids(model, reads)


def _put(model: mujoco.MjModel, impl: str, name: str) -> upstream.Model:
    try:
        return upstream.put_model(model, impl=impl)
    except NotImplementedError as reason:
        raise ValueError(f"physics {name} does not cover this model: {reason}") from None


def _advance(
    model: upstream.Model, data: upstream.Data, state: PhysicsState, ctrl: Array, frame_skip: int
) -> upstream.Data:
    data = data.replace(
        qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart, ctrl=ctrl
    )
    return jax.lax.scan(
        lambda d, _: (upstream.step(model, d), None), data, None, length=frame_skip
    )[0]
