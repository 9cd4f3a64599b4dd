"""The engines by name.

Importing this loads no engine: names are checked before JAX or MuJoCo are imported.
"""

from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import mujoco

    from dgae_jax.physics.engine import Physics, Reads


class Engine(NamedTuple):
    """An engine and its requirements."""

    on_host: bool = False
    """True if it simulates on the CPU whatever JAX's device is."""
    package: str | None = None
    """Name of the module needed, which is also the name of our extra."""


ENGINES = {
    "jax": Engine(),
    "mjx": Engine(),
    "mjx-warp": Engine(package="warp"),
    "native": Engine(on_host=True),
}


def require(name: str) -> None:
    """Check that an engine can be used.

    Raises:
        ValueError: if `name` is unknown or its package is not installed.
    """
    if name not in ENGINES:
        raise ValueError(f"unknown physics {name!r}: must be one of {', '.join(ENGINES)}")
    package = ENGINES[name].package
    if package is not None and find_spec(package) is None:
        reason = f"needs the package {package}, which is not installed"
        raise ValueError(f'physics {name} {reason}: pip install "dgae_jax[{package}]"')


def make_physics(name: str, spec: "mujoco.MjSpec", frame_skip: int, reads: "Reads") -> "Physics":
    """Build the engine `name` over a model, with `frame_skip` substeps per control interval.

    Raises:
        ValueError: if the engine is unknown, not installed, or does not cover the model.
    """
    require(name)
    if name == "jax":
        from dgae_jax.physics.jax.forward import jax_engine as build
    elif name == "native":
        from dgae_jax.physics.native import native as build
    elif name == "mjx":
        from dgae_jax.physics.mjx import mjx as build
    else:
        from dgae_jax.physics.mjx import mjx_warp as build
    return build(spec, frame_skip, reads)
