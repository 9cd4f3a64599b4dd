"""The engines by name.

Importing this loads no engine: names are checked before JAX or MuJoCo are imported.
"""

from importlib.util import find_spec
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import mujoco

    from dgae_jax.physics.engine import Physics, Reads


class Engine(NamedTuple):
    """An engine, and what it needs."""

    builder: str
    """Where the function is that builds it."""
    package: str | None = None
    """Name of the module needed, which is also the name of our extra."""


ENGINES = {
    "jax": Engine("dgae_jax.physics.jax.forward:jax_engine"),
    "mjx": Engine("dgae_jax.physics.mjx:mjx"),
    "mjx-warp": Engine("dgae_jax.physics.mjx:mjx_warp", package="warp"),
    "native": Engine("dgae_jax.physics.native:native"),
}


def require(name: str) -> None:
    """Raise ValueError if the package of an engine is not installed."""
    package = ENGINES[name].package
    if package is not None and find_spec(package) is None:
        reason = f"needs the package {package}, which is not installed"
        raise ValueError(f'physics {name} {reason}: pip install "dgae_jax[{package}]"')


def make_physics(name: str, spec: "mujoco.MjSpec", frame_skip: int, reads: "Reads") -> "Physics":
    """Build the engine `name` over a model, with `frame_skip` substeps per control interval.

    Raises:
        ValueError: if the engine is not installed, or does not cover the model.
    """
    require(name)
    return resolve_name(ENGINES[name].builder)(spec, frame_skip, reads)
