"""The engines by name. Importing this loads no engine, so that names can be checked before JAX or MuJoCo are imported."""

from importlib.util import find_spec
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import mujoco

    from dgae_jax.physics.engine import Physics, Reads


class Engine(NamedTuple):
    """Where an engine is built, and what it needs."""

    builder: str
    """`module:function` of (spec, frame_skip, reads), which returns a `Physics`."""
    about: str
    """What it is and where it serves, for help texts."""
    on_host: bool = False
    """Whether it simulates on the CPU whatever JAX's device is."""
    package: str | None = None
    """Module that must be installed beside the dependencies."""
    extra: str | None = None
    """The extra of this package that installs it."""


ENGINES = {
    "jax": Engine(
        "dgae_jax.physics.jax.engine:jax_engine", "MuJoCo's stages in our own JAX code, CPU or GPU"
    ),
    "mjx": Engine(
        "dgae_jax.physics.mjx:mjx", "google-deepmind's MuJoCo MJX, unchanged, any device"
    ),
    "mjx-warp": Engine(
        "dgae_jax.physics.mjx:mjx_warp",
        "MuJoCo MJX over MuJoCo Warp, NVIDIA GPUs",
        package="warp",
        extra="warp",
    ),
    "native": Engine("dgae_jax.physics.native:native", "C MuJoCo, CPU", on_host=True),
}


def require(name: str) -> None:
    """Raise ValueError, naming what exists or how to install it, for an engine that cannot be used."""
    if name not in ENGINES:
        raise ValueError(f"unknown physics {name!r}: must be one of {', '.join(ENGINES)}")
    package, extra = ENGINES[name].package, ENGINES[name].extra
    if package is not None and find_spec(package) is None:
        raise ValueError(
            f'physics {name} needs the package {package}, which is not installed: pip install "dgae_jax[{extra}]"'
        )


def make_physics(name: str, spec: "mujoco.MjSpec", frame_skip: int, reads: "Reads") -> "Physics":
    """The engine `name` over a model, advancing `frame_skip` substeps at a time and returning what `reads` names.

    Raises ValueError, naming the reason, for an unknown or missing engine and for a model that it does not cover.
    """
    require(name)
    return resolve_name(ENGINES[name].builder)(spec, frame_skip, reads)
