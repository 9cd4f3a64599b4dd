"""Pictures of a task's robot, drawn by MuJoCo."""

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from dgae_jax.envs import gym_tasks
from dgae_jax.envs.registry import spec_of
from dgae_jax.envs.task import load_spec

CAMERAS = {
    "ant": (3.8, -24, 65, 0.35),
    "hopper": (3.0, -8, 90, 0.7),
    "swimmer": (4.6, -50, 90, 0.0),
    "walker2d": (3.2, -8, 90, 0.72),
}
"""Distance [m], elevation and azimuth [degrees] of each camera, and the height it looks at [m]."""

SKY = ((1.0, 1.0, 1.0), (0.80, 0.88, 0.95))
"""The models' own sky is dark, which is lost in print."""

GROUND = ((0.86, 0.89, 0.90), (0.74, 0.79, 0.82))

LAMP, AMBIENT, HEADLIGHT = (0.4, 0.4, 0.4), (0.45, 0.45, 0.45), (0.3, 0.3, 0.3)
"""Together about 1, so that the ground keeps its colors."""


class Renderer(mujoco.Renderer):
    """MuJoCo's renderer of one task, with a camera and a lamp that follow the robot."""

    def __init__(self, env: str, version: str | None, width: int, height: int):
        """Open an OpenGL context for pictures of this size in pixels."""
        super().__init__(_model(env, version, width, height), height, width)
        self._camera = camera = mujoco.MjvCamera()
        camera.distance, camera.elevation, camera.azimuth, self._look_at = CAMERAS[env]
        self._data = mujoco.MjData(self.model)

    def draw(self, qpos: Float[np.ndarray, " Q"]) -> UInt8[np.ndarray, "H W 3"]:
        """Draw the robot at these positions (m, rad)."""
        self._data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self._data)
        x, y, _ = self._data.body("torso").subtree_com
        self._camera.lookat[:] = x, y, self._look_at
        self._data.light_xpos[:] = x, y, 4  # a lamp that stays behind casts no shadow
        self.update_scene(self._data, self._camera)
        return self.render().copy()


def _model(env: str, version: str | None, width: int, height: int) -> mujoco.MjModel:
    """Load Gymnasium's model, in colors for print."""
    name, _, version = str(spec_of(env).eval_env(version)).partition("-")
    spec = load_spec(gym_tasks.GYM_TASKS[name.lower()].FILE[version])
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
    model.vis.quality.shadowsize = 2048  # on a CPU finer shadows take most of the time
    return model
