"""Our tasks as Gymnasium's vector environments: one compiled step for all worlds, NumPy at the boundary.

Importing this registers them with Gymnasium: `gymnasium.make_vec("dgae_jax.export.vector:dgae_jax/Hopper-v5", num_envs=16)`.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import ArrayLike, Bool, Float, UInt8

from dgae_jax.configs.config import invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.base import Env
from dgae_jax.envs.registry import TASKS, make_env, spec_of
from dgae_jax.envs.task import Task
from dgae_jax.export.stage import CAMERAS, Stage
from dgae_jax.export.stepping import MODES, Worlds, blank, keys_of, renew
from dgae_jax.learn.rollout import where

SIZE = 480
"""Width and height of a picture [pixels], as Gymnasium's."""

Seeds = int | Iterable[int | None] | None


class VectorTask(VectorEnv):
    """N worlds of one task, whose `env` is the Brax environment. `make_vector_env` makes it."""

    def __init__(
        self, env: Env, num_envs: int, mode: AutoresetMode, limit: int, stage: partial[Stage] | None
    ):
        self.env, self.num_envs, self._mode, self._new_stage = env, num_envs, mode, stage
        drawn = (
            {"render_modes": ["rgb_array"], "render_fps": round(1 / float(env.dt))}
            if isinstance(env, Task)
            else {"render_modes": []}
        )
        self.metadata = {"autoreset_mode": mode, **drawn}
        self.render_mode = None if stage is None else "rgb_array"
        obs: Any = jax.eval_shape(env.reset, jax.random.key(0)).obs
        low, high = (np.asarray(x, np.float32) for x in env.action_range)
        self.single_observation_space = Box(-np.inf, np.inf, obs.shape, obs.dtype.type)
        self.single_action_space = Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._renew = jax.jit(partial(renew, env))
        self._place = jax.jit(jax.vmap(lambda state, qpos, qvel: env.set_state(state, qpos, qvel)))
        self._advance = jax.jit(partial(MODES[mode.value], env, limit))
        self._worlds: Worlds | None = None
        self._seeds: list[int | None] = [None] * num_envs
        self._stage: Stage | None = None

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride] as SyncVectorEnv's
        """What each world was last seeded with; None before its first reset."""
        return tuple(self._seeds)

    @property
    def state(self) -> Any:
        """The worlds as the Brax environment keeps them, arrays of JAX with a leading axis N; raises ResetNeeded before a reset."""
        return self._ready().state

    def set_state(
        self, qpos: Float[ArrayLike, "N Q"], qvel: Float[ArrayLike, "N V"]
    ) -> Float[np.ndarray, "N O"]:
        """Move every world to a pose, as Gymnasium's `set_state`, and return the observations; for our own tasks."""
        worlds = self._ready()
        self._worlds = worlds._replace(
            state=self._place(worlds.state, np.asarray(qpos), np.asarray(qvel))
        )
        return self._observations()

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A fresh episode in every world, or in those of `options["reset_mask"]` [N] -> (observations [N, O], {}).

        World i is seeded with `seed + i`, or with the i-th of a list; where no seed is given it goes on from the one before, the
        first time from a random one. Raises ValueError for a seed or an option that does not fit.
        """
        seeds, mask = _seeds(seed, self.num_envs), _reset_mask(options or {}, self.num_envs)
        if self._worlds is None:
            if not mask.all():
                raise ResetNeeded(
                    "the first reset is one of all worlds: reset_mask leaves some out"
                )
            drawn = self.np_random.integers(2**63, size=self.num_envs)
            seeds = [int(d) if s is None else s for s, d in zip(seeds, drawn, strict=True)]
            self._worlds = blank(self.env, keys_of([0] * self.num_envs))
        given = mask & [s is not None for s in seeds]
        self._seeds = [
            s if new else old for s, old, new in zip(seeds, self._seeds, given, strict=True)
        ]
        keys = where(jnp.asarray(given), keys_of([s or 0 for s in seeds]), self._ready().keys)
        self._worlds = self._renew(self._ready()._replace(keys=keys), mask)
        return self._observations(), {}

    def step(
        self, actions: Float[ArrayLike, "N A"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every world -> observations [N, O], rewards, terminations, truncations [N], infos.

        Actions are the actuators' controls: MuJoCo clips them, the control cost takes them as given. Raises ValueError for
        another shape, ResetNeeded before a reset and, where nothing resets by itself, after the end of an episode.
        """
        worlds = self._ready()
        waiting = np.asarray(worlds.over)
        if self._mode is AutoresetMode.DISABLED and waiting.any():
            raise ResetNeeded(
                f"worlds {np.flatnonzero(waiting).tolist()} are at the end of an episode: reset them by reset_mask"
            )
        actions = np.asarray(actions, self.single_observation_space.dtype)
        if actions.shape != self.action_space.shape:
            raise invalid(
                "actions", f"of shape {actions.shape}", f"of shape {self.action_space.shape}"
            )
        self._worlds, step = self._advance(worlds, actions)
        step = jax.tree.map(np.array, step)
        replaced = (step.terminated | step.truncated) & (self._mode is AutoresetMode.SAME_STEP)
        infos = _infos(step.infos, ~waiting & ~replaced)
        if replaced.any():
            final = {
                "final_obs": _objects(step.obs, replaced),
                "final_info": _infos(step.infos, replaced),
            }
            infos |= final | {f"_{name}": replaced.copy() for name in final}
        return (
            self._observations(),
            step.reward.astype(np.float64),
            step.terminated,
            step.truncated,
            infos,
        )

    def render(self) -> tuple[UInt8[np.ndarray, "H W 3"], ...] | None:
        """A picture of each world; None without a render mode."""
        if self._new_stage is None:
            return None
        self._stage = self._stage or self._new_stage()
        poses = (
            np.asarray(self.state.pipeline_state.qpos),
            np.asarray(self.state.pipeline_state.qvel),
        )
        return tuple(self._stage.picture(qpos, qvel) for qpos, qvel in zip(*poses, strict=True))

    def close_extras(self, **_: Any) -> None:
        """Free the OpenGL context, if there is one."""
        if self._stage is not None:
            self._stage.close()

    def _ready(self) -> Worlds:
        if self.closed:
            raise ClosedEnvironmentError("the environment is closed")
        if self._worlds is None:
            raise ResetNeeded("the environment must be reset before anything else")
        return self._worlds

    def _observations(self) -> np.ndarray:
        return np.array(self.state.obs)


def _seeds(seed: Seeds, count: int) -> list[int | None]:
    """One for each world, None where it is to go on as it is."""
    if seed is None or isinstance(seed, int | np.integer):
        seeds = [None if seed is None else int(seed) + i for i in range(count)]
    else:
        seeds = list(seed)
    if len(seeds) != count or any(
        s is not None and not (isinstance(s, int | np.integer) and s >= 0) for s in seeds
    ):
        raise invalid(
            "seed",
            seed,
            f"a number of at least 0, or {count} of them, None where a world goes on as it is",
        )
    return [None if s is None else int(s) for s in seeds]


def _reset_mask(options: dict[str, Any], count: int) -> Bool[np.ndarray, " N"]:
    if unknown := set(options) - {"reset_mask"}:
        raise invalid("options", ", ".join(map(repr, sorted(unknown))), "reset_mask, or left out")
    mask = np.asarray(options.get("reset_mask", np.full(count, True)))
    if mask.shape != (count,) or mask.dtype != bool or not mask.any():
        raise invalid("reset_mask", mask, f"{count} booleans, one of them true")
    return mask


def _infos(values: dict[str, np.ndarray], mask: Bool[np.ndarray, " N"]) -> dict[str, Any]:
    """As Gymnasium has them: zero outside the mask, which stands under `_name`; nothing where it is empty."""
    shown = values if mask.any() else {}
    return {name: np.where(mask, x, np.zeros_like(x)) for name, x in shown.items()} | {
        f"_{name}": mask.copy() for name in shown
    }


def _objects(rows: np.ndarray, mask: Bool[np.ndarray, " N"]) -> np.ndarray:
    """An array of objects [N]: a row where the mask says so, None elsewhere."""
    objects = np.full(len(rows), None, object)
    for i in np.flatnonzero(mask):
        objects[i] = rows[i].copy()
    return objects


def make_vector_env(
    name: str,
    num_envs: int,
    *,
    physics: str | None = None,
    version: str | None = None,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    max_episode_steps: int = ResolvedConfig.episode_length,
    render_mode: str | None = None,
    **task_parameters,
) -> VectorTask:
    """`num_envs` worlds of `make_env(name, physics=…, version=…, **task_parameters)` as a `gymnasium.vector.VectorEnv`.

    Episodes are truncated after `max_episode_steps`. `autoreset_mode` is what Gymnasium calls so: what happens where an episode ends.
    `render_mode` "rgb_array" is for our own tasks. Raises ValueError, naming what is allowed, as `make_env` and for these.
    """
    modes = {mode.value: mode for mode in AutoresetMode}
    mode = modes.get(str(getattr(autoreset_mode, "value", autoreset_mode)))
    if mode is None:
        raise invalid("autoreset_mode", autoreset_mode, f"one of {', '.join(modes)}")
    for setting, value in {"num_envs": num_envs, "max_episode_steps": max_episode_steps}.items():
        if not isinstance(value, int | np.integer) or value < 1:
            raise invalid(setting, value, "a whole number of at least 1")
    if render_mode is not None and (render_mode != "rgb_array" or name not in CAMERAS):
        raise invalid(
            "render_mode", render_mode, f"left out, or rgb_array with {', '.join(CAMERAS)}"
        )
    env = make_env(name, physics=physics, version=version, **task_parameters)
    if spec_of(name).on_host:
        raise invalid("name", name, "a task in JAX; gymnasium.make_vec makes those of Gymnasium")
    stage = None if render_mode is None else partial(Stage, name, version, width=SIZE, height=SIZE)
    return VectorTask(env, int(num_envs), mode, int(max_episode_steps), stage)


for _name, _spec in TASKS.items():
    for _version, _referee in _spec.referees.items():
        gymnasium.register(
            f"dgae_jax/{_referee}",
            vector_entry_point=f"{__name__}:make_vector_env",
            max_episode_steps=ResolvedConfig.episode_length,
            kwargs={"name": _name, "version": _version},
        )
