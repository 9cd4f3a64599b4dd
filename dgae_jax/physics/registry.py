"""The engines by name.

Importing this loads no engine: names are checked before JAX or MuJoCo are imported.
"""

from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

    from dgae_jax.physics.engine import Physics, Reads


ENGINES: dict[str, str | None] = {"jax": None, "mjx": None, "mjx-warp": "warp", "native": None}
"""The engines, and the module that each needs beyond our dependencies: the name of our extra."""


def require(name: str) -> None:
    """Raise ValueError if the package of an engine is not installed."""
    package = ENGINES[name]
    if package is not None and find_spec(package) is None:
        reason = f"needs the package {package}, which is not installed"
        raise ValueError(f'physics {name} {reason}: pip install "dgae_jax[{package}]"')


def make_physics(name: str, spec: "mujoco.MjSpec", frame_skip: int, reads: "Reads") -> "Physics":
    """Build the engine `name` over a model, with `frame_skip` substeps per control interval.

    Raises:
        ValueError: if the engine is not installed, or does not cover the model.
    """
    require(name)
    from dgae_jax.physics import engine, mjx, native
    from dgae_jax.physics.jax import forward

    engine.silence_warnings()
    builders = {
        "jax": forward.jax_engine,
        "mjx": mjx.mjx,
        "mjx-warp": mjx.mjx_warp,
        "native": native.native,
    }
    return builders[name](spec, frame_skip, reads)
