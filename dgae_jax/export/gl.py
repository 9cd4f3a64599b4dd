"""Which OpenGL MuJoCo draws with where there is no screen.

MuJoCo decides when it is imported and cannot decide again in the same process. So each candidate is tried in a process of its own,
and MUJOCO_GL is set before MuJoCo is imported here. Nothing in this module imports it.
"""

import os
import subprocess
import sys

from dgae_jax.configs.config import ConfigError

VARIABLE = "MUJOCO_GL"

CANDIDATES = ("cgl",) if sys.platform == "darwin" else ("egl", "osmesa")
"""In this order: EGL draws on a GPU if there is one, OSMesa always on the CPU."""

_TRIAL = (
    "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16).render()"
)

_PATIENCE = 60
"""Seconds after which a candidate that hangs counts as broken."""


def choose() -> str:
    """The backend that draws here, also in MUJOCO_GL for this process; one that the user put there is tried and never replaced.

    To be called before MuJoCo is imported. Raises ConfigError if none draws.
    """
    given = os.environ.get(VARIABLE)
    if given:
        if not draws(given):
            allowed = f"{', '.join(CANDIDATES)} or another that draws a picture here, or left out"
            raise ConfigError(f"{VARIABLE}={given}: must be {allowed}")
        return given
    for backend in CANDIDATES:
        if draws(backend):
            os.environ[VARIABLE] = backend
            return backend
    tried = " nor ".join(CANDIDATES)
    raise ConfigError(
        f"{VARIABLE}: neither {tried} draws a picture here; on Debian: apt install libegl1 libgl1-mesa-dri, or libosmesa6"
    )


def draws(backend: str) -> bool:
    """Whether a process with this backend can draw a picture."""
    try:
        environment = {**os.environ, VARIABLE: backend}
        return (
            subprocess.run(
                [sys.executable, "-c", _TRIAL],
                env=environment,
                capture_output=True,
                timeout=_PATIENCE,
            ).returncode
            == 0
        )
    except subprocess.TimeoutExpired:
        return False
