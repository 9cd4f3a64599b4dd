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
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
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

SIZE = 480
"""Width and height of a picture [pixels], as in Gymnasium."""

Seeds = int | Iterable[int | None] | None


class EnvStates(NamedTuple):
    """The envs, and the episode that each of them is in."""

    env: Any
    steps: Int[Array, " N"]
    """In the episode so far."""
    done: Bool[Array, " N"]
    """Where the episode has ended and no other has begun."""
    keys: Key[Array, " N"]
    """Of the next reset: each env has its own, so that resets do not depend on other envs."""


def _fresh(env: Env, keys: Key[Array, " N"]) -> EnvStates:
    reset, rest = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
    count = len(keys)
    states = jax.vmap(env.reset)(reset)
    return EnvStates(states, jnp.zeros(count, jnp.int32), jnp.full(count, False), rest)


def _reset(env: Env, states: EnvStates, mask: Bool[Array, " N"]) -> EnvStates:
    return where(mask, _fresh(env, states.keys), states)


def _step(
    env: Env, limit: int, mode: AutoresetMode, states: EnvStates, action: Float[Array, "N A"]
) -> tuple[EnvStates, tuple[Any, ...]]:
    """Take one step in every env, and reset envs after the end of an episode as `mode` says.

    As in training, an env that turns non-finite ends its episode as terminated with reward 0, and
    shows the observation before.

    Returns:
        The states, and what the step showed before any reset: obs [N, O], reward, terminated,
        truncated [N], and infos, the task's metrics [N] with `nonfinite`.
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


def _keys_of(seeds: list[int]) -> Key[Array, " N"]:
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
        make_renderer: partial[Renderer] | None,
    ):
        self.env, self.num_envs, self._mode = env, num_envs, mode
        self._make_renderer, self._renderer = make_renderer, None
        self.metadata = {"autoreset_mode": mode, "render_modes": []}
        if isinstance(env, Task):
            self.metadata |= {"render_modes": ["rgb_array"], "render_fps": round(1 / env.dt)}
        self.render_mode = None if make_renderer is None else "rgb_array"
        obs: Any = jax.eval_shape(env.reset, jax.random.key(0)).obs
        low, high = (np.asarray(x, np.float32) for x in env.action_range)
        self.single_observation_space = Box(-np.inf, np.inf, obs.shape, obs.dtype.type)
        self.single_action_space = Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset = jax.jit(partial(_reset, env))
        self._set_state = jax.jit(jax.vmap(lambda *args: env.set_state(*args)))
        self._step = jax.jit(partial(_step, env, limit, mode))
        self._states: EnvStates | None = None
        self._seeds: list[int | None] = [None] * num_envs

    @property  # a tuple, as SyncVectorEnv's
    def np_random_seed(self) -> Any:
        """The last seed of each env; None before its first reset."""
        return tuple(self._seeds)

    @property
    def state(self) -> Any:
        """The states of the Brax environment, with a leading axis N."""
        return self._ready().env

    def set_state(
        self, qpos: Float[ArrayLike, "N Q"], qvel: Float[ArrayLike, "N V"]
    ) -> Float[np.ndarray, "N O"]:
        """Move every env to a pose, as Gymnasium's `set_state`, and return the observations."""
        states = self._ready()
        env = self._set_state(states.env, np.asarray(qpos), np.asarray(qvel))
        self._states = states._replace(env=env)
        return self._observations()

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode in every env, or in those of `options["reset_mask"]` [N].

        Args:
            seed: env i is seeded with `seed + i`, or with the i-th of a list. Without a seed its
                random stream continues, and begins at random.
            options: `reset_mask` or nothing.

        Returns:
            The observations [N, O] and {}.

        Raises:
            ValueError: a seed or an option does not fit.
            ResetNeeded: the first reset leaves envs out.
        """
        seeds, mask = _seeds(seed, self.num_envs), _reset_mask(options or {}, self.num_envs)
        if self._states is None:
            if not mask.all():
                raise ResetNeeded("the first reset must be of all envs, without reset_mask")
            random = self.np_random.integers(2**63, size=self.num_envs)
            seeds = [int(r) if s is None else s for s, r in zip(seeds, random, strict=True)]
            keys = _keys_of([0] * self.num_envs)
            shapes = jax.eval_shape(partial(_fresh, self.env), keys)._replace(keys=None)
            zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
            self._states = zeros._replace(keys=keys)
        states, given = self._ready(), mask & [s is not None for s in seeds]
        pairs = zip(given, seeds, self._seeds, strict=True)
        self._seeds = [new if is_new else old for is_new, new, old in pairs]
        keys = where(jnp.asarray(given), _keys_of([s or 0 for s in seeds]), states.keys)
        self._states = self._reset(states._replace(keys=keys), mask)
        return self._observations(), {}

    def step(
        self, actions: Float[ArrayLike, "N A"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one step in every env.

        Args:
            actions: the actuators' controls. MuJoCo clips them, the control cost does not.

        Returns:
            Observations [N, O], rewards, terminations, truncations [N], infos.

        Raises:
            ValueError: the actions have another shape.
            ResetNeeded: before a reset, or after the end of an episode with mode `Disabled`.
        """
        states = self._ready()
        waiting = np.asarray(states.done)
        if self._mode is AutoresetMode.DISABLED and waiting.any():
            ended = np.flatnonzero(waiting).tolist()
            raise ResetNeeded(f"the episodes of envs {ended} have ended: reset them by reset_mask")
        actions = np.asarray(actions, self.single_observation_space.dtype)
        if actions.shape != self.action_space.shape:
            shape = self.action_space.shape
            raise invalid("actions", f"of shape {actions.shape}", f"of shape {shape}")
        self._states, step = self._step(states, actions)
        obs, reward, terminated, truncated, metrics = jax.tree.map(np.array, step)
        replaced = (terminated | truncated) & (self._mode is AutoresetMode.SAME_STEP)
        infos = _infos(metrics, ~waiting & ~replaced)
        if replaced.any():
            final_obs = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(replaced):
                final_obs[i] = obs[i].copy()
            infos |= {"final_obs": final_obs, "final_info": _infos(metrics, replaced)}
            infos |= {"_final_obs": replaced.copy(), "_final_info": replaced.copy()}
        return self._observations(), reward.astype(np.float64), terminated, truncated, infos

    def render(self) -> tuple[UInt8[np.ndarray, "H W 3"], ...] | None:
        """Return a picture of each env, or None without a render mode."""
        if self._make_renderer is None:
            return None
        self._renderer = self._renderer or self._make_renderer()
        pose = self.state.pipeline_state
        poses = zip(np.asarray(pose.qpos), np.asarray(pose.qvel), strict=True)
        return tuple(self._renderer.render(qpos, qvel) for qpos, qvel in poses)

    def close_extras(self, **_: Any) -> None:
        """Free the OpenGL context, if there is one."""
        if self._renderer is not None:
            self._renderer.close()

    def _ready(self) -> EnvStates:
        if self.closed:
            raise ClosedEnvironmentError("the environment is closed")
        if self._states is None:
            raise ResetNeeded("call reset before anything else")
        return self._states

    def _observations(self) -> np.ndarray:
        return np.array(self.state.obs)


def _seeds(seed: Seeds, count: int) -> list[int | None]:
    """Return a seed for each env, None where its random stream continues."""
    if seed is None or isinstance(seed, int | np.integer):
        seeds = [None if seed is None else int(seed) + i for i in range(count)]
    else:
        seeds = list(seed)
    fits = [s is None or (isinstance(s, int | np.integer) and s >= 0) for s in seeds]
    if len(seeds) != count or not all(fits):
        raise invalid("seed", seed, f"a number of at least 0, or a list of {count} (or None)")
    return [None if s is None else int(s) for s in seeds]


def _reset_mask(options: dict[str, Any], count: int) -> Bool[np.ndarray, " N"]:
    if unknown := set(options) - {"reset_mask"}:
        raise invalid("options", ", ".join(map(repr, sorted(unknown))), "reset_mask, or left out")
    mask = np.asarray(options.get("reset_mask", np.full(count, True)))
    if mask.shape != (count,) or mask.dtype != bool or not mask.any():
        raise invalid("reset_mask", mask, f"{count} booleans, at least one of them true")
    return mask


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
    modes = {mode.value: mode for mode in AutoresetMode}
    mode = modes.get(str(getattr(autoreset_mode, "value", autoreset_mode)))
    if mode is None:
        raise invalid("autoreset_mode", autoreset_mode, f"one of {', '.join(modes)}")
    for setting, value in {"num_envs": num_envs, "max_episode_steps": max_episode_steps}.items():
        if not isinstance(value, int | np.integer) or value < 1:
            raise invalid(setting, value, "a whole number of at least 1")
    if render_mode is not None and (render_mode != "rgb_array" or name not in CAMERAS):
        allowed = f"left out, or rgb_array with {', '.join(CAMERAS)}"
        raise invalid("render_mode", render_mode, allowed)
    env = make_env(name, physics=physics, version=version, **task_parameters)
    if spec_of(name).on_host:
        raise invalid("name", name, "a task in JAX; use gymnasium.make_vec for Gymnasium's")
    renderer = partial(Renderer, name, version, width=SIZE, height=SIZE)
    limit, make_renderer = int(max_episode_steps), None if render_mode is None else renderer
    return VectorTask(env, int(num_envs), mode, limit, make_renderer)


for _name, _spec in TASKS.items():
    for _version, _id in _spec.eval_envs.items():
        gymnasium.register(
            f"dgae_jax/{_id}",
            vector_entry_point=f"{__name__}:make_vector_env",
            max_episode_steps=ResolvedConfig.episode_length,
            kwargs={"name": _name, "version": _version},
        )
