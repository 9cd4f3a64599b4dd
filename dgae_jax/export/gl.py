"""Choice of the OpenGL backend with which MuJoCo draws without a screen.

MuJoCo reads MUJOCO_GL when it is imported and never again. So each candidate is tried in a process
of its own before MuJoCo is imported here; this module does not import it.
"""

import functools
import os
import subprocess
import sys

from dgae_jax.configs.config import ConfigError

VARIABLE = "MUJOCO_GL"

CANDIDATES = ("cgl",) if sys.platform == "darwin" else ("egl", "osmesa")
"""In order of preference: EGL uses a GPU if there is one, OSMesa always the CPU."""

_TRIAL = (
    "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16).render()"
)


def choose() -> str:
    """Set MUJOCO_GL to a backend that works; call this before MuJoCo is imported.

    Returns:
        The backend. One that the user has set is tried, and never replaced.

    Raises:
        ConfigError: no backend works.
    """
    chosen = os.environ.get(VARIABLE)
    for backend in [chosen] if chosen else CANDIDATES:
        if works(backend):
            os.environ[VARIABLE] = backend
            return backend
    remedy = "unset it" if chosen else "apt install libegl1 libgl1-mesa-dri, or libosmesa6"
    tried = chosen or " or ".join(CANDIDATES)
    raise ConfigError(f"{VARIABLE}: cannot draw with {tried}; {remedy}")


@functools.cache
def works(backend: str) -> bool:
    """Return whether MuJoCo can draw with this backend, within a minute."""
    environment = {**os.environ, VARIABLE: backend}
    command = [sys.executable, "-c", _TRIAL]
    try:
        subprocess.run(command, env=environment, capture_output=True, timeout=60, check=True)
    except subprocess.SubprocessError:
        return False
    return True
