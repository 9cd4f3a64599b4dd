"""A task's robot as a picture, drawn by MuJoCo from positions and velocities."""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from dgae_jax.envs import gym_tasks
from dgae_jax.envs.registry import spec_of
from dgae_jax.envs.task import load_spec


class Camera(NamedTuple):
    """Where the robot is seen from. It follows the centre of mass of the robot in x and y, its height stays."""

    distance: float
    """From what it looks at [m]."""
    elevation: float
    """Of the line of sight, negative from above [degrees]."""
    azimuth: float
    """Of the line of sight, 90 along y [degrees]."""
    height: float
    """Of the point it looks at [m]."""


CAMERAS = {
    "ant": Camera(3.8, -24, 65, 0.35),
    "hopper": Camera(3.0, -8, 90, 0.7),
    "swimmer": Camera(4.6, -50, 90, 0.0),
    "walker2d": Camera(3.2, -8, 90, 0.72),
}

SKY = ((1.0, 1.0, 1.0), (0.80, 0.88, 0.95))
"""Colours of the sky; that of the models is dark, and is lost in print."""

GROUND = ((0.86, 0.89, 0.90), (0.74, 0.79, 0.82))
"""Colours of the squares of the ground."""

LAMP, AMBIENT, HEADLIGHT = (0.4, 0.4, 0.4), (0.45, 0.45, 0.45), (0.3, 0.3, 0.3)
"""Light from above, from all around and from where one looks; together about 1, so that the ground keeps its colours."""

LAMP_HEIGHT = 4.0
"""Of the light from above [m]; it must be above the robot."""

SHADOW = 2048
"""Resolution of shadows [pixels]; finer ones take most of the time where the CPU draws."""


class Stage:
    """A renderer of one task; to be closed, or used as a context."""

    def __init__(self, env: str, version: str | None, *, width: int, height: int):
        """`width` and `height` of the pictures in pixels. Raises ValueError for a task that has no model file."""
        self._camera = mujoco.MjvCamera()
        settings = CAMERAS[env]
        self._camera.distance, self._camera.elevation, self._camera.azimuth = settings[:3]
        self._height = settings.height
        self.model = _model(env, version, width, height)
        self._data = mujoco.MjData(self.model)
        self._renderer = mujoco.Renderer(self.model, height, width)

    def __enter__(self) -> "Stage":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def picture(
        self, qpos: Float[np.ndarray, " Q"], qvel: Float[np.ndarray, " V"] | None = None
    ) -> UInt8[np.ndarray, "H W 3"]:
        """The robot at these positions (m, rad) and velocities, by default at rest."""
        self._data.qpos[:] = qpos
        self._data.qvel[:] = 0 if qvel is None else qvel
        mujoco.mj_forward(self.model, self._data)
        x, y, _ = self._data.body("torso").subtree_com
        self._camera.lookat[:] = x, y, self._height
        self._data.light_xpos[:] = (
            x,
            y,
            LAMP_HEIGHT,
        )  # a lamp that stays behind casts no shadow here
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render().copy()


def _model(env: str, version: str | None, width: int, height: int) -> mujoco.MjModel:
    """The model that Gymnasium plays, in colours for print."""
    name, _, version = str(spec_of(env).referee(version)).partition("-")
    spec = load_spec(getattr(gym_tasks, name).FILE[version])
    for texture in spec.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            texture.rgb1, texture.rgb2 = SKY
        if texture.builtin == mujoco.mjtBuiltin.mjBUILTIN_CHECKER:
            texture.rgb1, texture.rgb2 = GROUND
    for material in spec.materials:
        material.reflectance = 0
    spec.geom("floor").rgba = (1, 1, 1, 1)
    for light in spec.lights:
        light.diffuse, light.specular = LAMP, (0, 0, 0)
    model = spec.compile()
    model.vis.headlight.ambient, model.vis.headlight.diffuse = AMBIENT, HEADLIGHT
    model.vis.headlight.specular = (0, 0, 0)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    model.vis.quality.shadowsize = SHADOW
    return model
