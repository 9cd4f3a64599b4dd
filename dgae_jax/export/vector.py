"""The tasks as Gymnasium vector environments: one compiled step for all envs, NumPy at the border.

Importing this module registers them with Gymnasium:
`gymnasium.make_vec("dgae_jax.export.vector:dgae_jax/Hopper-v5", num_envs=16)`.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key, UInt8

from dgae_jax.configs.config import invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.base import Env
from dgae_jax.envs.registry import TASKS, make_env, spec_of
from dgae_jax.envs.task import Task
from dgae_jax.export.renderer import CAMERAS, Renderer
from dgae_jax.learn.rollout import ends, finite, where


class EnvStates(NamedTuple):
    """The envs, and the episode that each of them is in."""

    env: Any
    steps: Int[Array, " N"]
    """In the episode so far."""
    done: Bool[Array, " N"]
    """Where no episode has begun, or the last has ended."""
    keys: Key[Array, " N"]
    """Of the next reset: each env has its own, so that resets do not depend on other envs."""


def _reset(env: Env, states: EnvStates, mask: Bool[Array, " N"]) -> EnvStates:
    reset, keys = jnp.moveaxis(jax.vmap(jax.random.split)(states.keys), 1, 0)
    steps, done = jnp.zeros_like(states.steps), jnp.zeros_like(states.done)
    return where(mask, EnvStates(jax.vmap(env.reset)(reset), steps, done, keys), states)


def _step(
    env: Env, limit: int, mode: AutoresetMode, states: EnvStates, action: Float[Array, "N A"]
) -> tuple[EnvStates, tuple[Any, ...]]:
    """Return the states after a step and resets, and what the step showed before any reset.

    As in training, an env that turns non-finite ends its episode as terminated with reward 0, and
    shows the observation before.
    """
    before, after = states.env, jax.vmap(env.step)(states.env, action)
    mask = finite((action, after.pipeline_state, after.reward, after.obs, after.done))
    masked = before.obs, *jax.tree.map(jnp.zeros_like, (after.reward, after.metrics))
    obs, reward, metrics = where(mask, (after.obs, after.reward, after.metrics), masked)
    steps = states.steps + 1
    over, truncated = ends(after, steps >= limit)
    terminated = over | ~mask
    done = terminated | truncated
    new = states._replace(env=after.replace(obs=obs), steps=steps, done=done)
    step = obs, reward, terminated, truncated, {**metrics, "nonfinite": ~mask}
    if mode is AutoresetMode.SAME_STEP:
        return _reset(env, new, done), step
    if mode is AutoresetMode.NEXT_STEP:  # a reset takes the place of a step, which shows zeros
        zeros = jax.tree.map(jnp.zeros_like, step)
        new = where(states.done, _reset(env, states, states.done), new)
        return new, where(states.done, zeros, step)
    return new, step


def _keys_of(seeds: Iterable[int]) -> Key[Array, " N"]:
    numbers = [np.random.SeedSequence(seed).generate_state(2) for seed in seeds]
    return jax.random.wrap_key_data(jnp.asarray(np.stack(numbers)), impl="threefry2x32")


class VectorTask(VectorEnv):
    """N envs of one task; `env` is the Brax environment. Made by `make_vector_env`."""

    def __init__(
        self,
        env: Env,
        num_envs: int,
        mode: AutoresetMode,
        limit: int,
        renderer: Renderer | None,
    ):
        self.env, self.num_envs, self._mode, self._renderer = env, num_envs, mode, renderer
        self.metadata = {"autoreset_mode": mode, "render_modes": []}
        if isinstance(env, Task):
            self.metadata |= {"render_modes": ["rgb_array"], "render_fps": round(1 / env.dt)}
        self.render_mode = "rgb_array" if renderer else None
        keys = _keys_of(np.random.SeedSequence().generate_state(num_envs, np.uint64))
        shapes: Any = jax.eval_shape(jax.vmap(env.reset), keys)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        steps, done = jnp.zeros(num_envs, jnp.int32), jnp.full(num_envs, True)
        self._states = EnvStates(zeros, steps, done, keys)
        low, high = (np.asarray(x, np.float32) for x in env.action_range)
        _, *shape = shapes.obs.shape
        self.single_observation_space = Box(-np.inf, np.inf, shape, shapes.obs.dtype.type)
        self.single_action_space = Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset = jax.jit(partial(_reset, env))
        self._set_state = jax.jit(jax.vmap(lambda *args: env.set_state(*args)))
        self._step = jax.jit(partial(_step, env, limit, mode))

    @property
    def state(self) -> Any:
        """The states of the Brax environment, with a leading axis N."""
        return self._states.env

    def set_state(
        self, qpos: Float[ArrayLike, "N Q"], qvel: Float[ArrayLike, "N V"]
    ) -> Float[np.ndarray, "N O"]:
        """Move every env to a pose, as Gymnasium's `set_state`, and return the observations."""
        env = self._set_state(self.state, np.asarray(qpos), np.asarray(qvel))
        self._states = self._states._replace(env=env)
        return np.array(env.obs)

    def reset(
        self,
        *,
        seed: int | Iterable[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode in every env, or in those of `options["reset_mask"]` [N].

        Env i is seeded with `seed + i`, or with the i-th of a list. Without a seed its random
        stream continues, and begins at random.
        """
        count = self.num_envs
        seeds = list(seed) if isinstance(seed, Iterable) else [seed] * count
        if isinstance(seed, int | np.integer):
            seeds = [int(seed) + i for i in range(count)]
        mask = np.asarray((options or {}).get("reset_mask", [True] * count))
        if len(seeds) != count:
            raise invalid("seed", seed, f"a number, or a list of {count}")
        if mask.shape != (count,) or mask.dtype != bool:
            raise invalid("reset_mask", mask, f"{count} booleans")
        given = jnp.asarray(mask & [s is not None for s in seeds])
        keys = where(given, _keys_of([s or 0 for s in seeds]), self._states.keys)
        self._states = self._reset(self._states._replace(keys=keys), mask)
        return np.array(self.state.obs), {}

    def step(
        self, actions: Float[ArrayLike, "N A"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one step in every env. MuJoCo clips the actions, the control cost does not.

        Raises:
            ValueError: the actions have another shape.
            ResetNeeded: an env is in no episode, in a mode in which a step begins none.
        """
        waiting = np.array(self._states.done)
        if self._mode is not AutoresetMode.NEXT_STEP and waiting.any():
            raise ResetNeeded(f"envs {np.flatnonzero(waiting)} are in no episode: reset them")
        actions = np.asarray(actions, self.single_observation_space.dtype)
        if actions.shape != self.action_space.shape:
            raise invalid("actions", f"of {actions.shape}", f"of shape {self.action_space.shape}")
        self._states, step = self._step(self._states, actions)
        obs, reward, terminated, truncated, metrics = jax.tree.map(np.array, step)
        replaced = (terminated | truncated) & (self._mode is AutoresetMode.SAME_STEP)
        infos = _infos(metrics, ~waiting & ~replaced)
        if replaced.any():
            final_obs = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(replaced):
                final_obs[i] = obs[i].copy()
            infos |= {"final_obs": final_obs, "final_info": _infos(metrics, replaced)}
            infos |= {"_final_obs": replaced.copy(), "_final_info": replaced.copy()}
        reward = reward.astype(np.float64)
        return np.array(self.state.obs), reward, terminated, truncated, infos

    def render(self) -> tuple[UInt8[np.ndarray, "H W 3"], ...] | None:
        """Return a picture of each env, or None without a render mode."""
        if self._renderer is None:
            return None
        return tuple(map(self._renderer.draw, np.asarray(self.state.pipeline_state.qpos)))

    def close_extras(self, **_: Any) -> None:
        """Free the OpenGL context, if there is one."""
        if self._renderer is not None:
            self._renderer.close()


def _infos(values: dict[str, np.ndarray], mask: Bool[np.ndarray, " N"]) -> dict[str, Any]:
    """Return Gymnasium's infos: zero outside the mask, which is in `_name`; empty without any."""
    if not mask.any():
        return {}
    infos = {name: np.where(mask, x, np.zeros_like(x)) for name, x in values.items()}
    return infos | {f"_{name}": mask.copy() for name in values}


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
    """Make a task as a `gymnasium.vector.VectorEnv`.

    Args:
        name: of the task, as for `make_env`.
        num_envs: how many envs step together.
        physics: the engine; by default the task's first.
        version: Gymnasium's version of the task.
        autoreset_mode: what happens where an episode ends, by Gymnasium's names.
        max_episode_steps: episodes are truncated after so many.
        render_mode: "rgb_array" for pictures of Gymnasium's MuJoCo tasks.
        **task_parameters: as for `make_env`.

    Raises:
        ValueError: an argument is invalid; the message names what is allowed.
    """
    if num_envs < 1:
        raise invalid("num_envs", num_envs, "at least 1")
    if render_mode is not None and (render_mode != "rgb_array" or name not in CAMERAS):
        allowed = f"left out, or rgb_array with {', '.join(CAMERAS)}"
        raise invalid("render_mode", render_mode, allowed)
    env = make_env(name, physics=physics, version=version, **task_parameters)
    if spec_of(name).on_host:
        raise invalid("name", name, "a task in JAX; use gymnasium.make_vec for Gymnasium's")
    mode = AutoresetMode(autoreset_mode)
    renderer = Renderer(name, version, 480, 480) if render_mode else None
    return VectorTask(env, num_envs, mode, max_episode_steps, renderer)


for _name, _spec in TASKS.items():
    for _version, _id in _spec.eval_envs.items():
        gymnasium.register(
            f"dgae_jax/{_id}",
            vector_entry_point=f"{__name__}:make_vector_env",
            max_episode_steps=ResolvedConfig.episode_length,
            kwargs={"name": _name, "version": _version},
        )
