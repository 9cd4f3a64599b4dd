"""Tasks of MuJoCo Playground under our trainer, unchanged, on MuJoCo MJX."""

import warnings
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.wrappers.training import EpisodeWrapper
from jaxtyping import Array, Float

from dgae_jax.envs.base import Env, State, ThirdPartyEnv
from dgae_jax.physics.engine import silence_warnings
from dgae_jax.physics.registry import require


class PlaygroundTask(ThirdPartyEnv):
    """A task with its own time limit and action repeat, as Playground's trainers wrap it.

    Truncations are in `info`. Of several observations the policy takes the one named `state`.
    Actions lie in [−1, 1].
    """

    def __init__(self, env: Any, physics: str, episode_length: int, action_repeat: int):
        obs = _policy_obs(jax.eval_shape(env.reset, jax.random.key(0)).obs)
        shape = getattr(obs, "shape", None)
        if shape is None or len(shape) != 1:
            raise ValueError("its observations must be one vector, or have one named state")
        self._env = EpisodeWrapper(env, episode_length, action_repeat)
        self.backend, self.observation_size, self.action_size = physics, shape[0], env.action_size
        self.action_range = -jnp.ones(self.action_size), jnp.ones(self.action_size)

    def reset(self, rng: Array) -> State:
        """Start an episode; `pipeline_state` is Playground's state."""
        return _state(self._env.reset(rng))

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Advance one control interval, or as many as the task repeats an action."""
        return _state(self._env.step(state.pipeline_state, action))  # pyright: ignore


def _policy_obs(obs: Any) -> Any:
    return obs.get("state") if isinstance(obs, Mapping) else obs


def _state(inner: Any) -> State:
    info = {"truncation": inner.info["truncation"]}
    return State(inner, _policy_obs(inner.obs), inner.reward, inner.done, info=info)


def make_playground(name: str, physics: str, **parameters) -> Env:
    """Build a task of Playground, if possible; `parameters` override its configuration."""
    require(physics)
    silence_warnings()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from mujoco_playground import dm_control_suite, registry  # pyright: ignore
        from mujoco_playground._src.mjx_env import MENAGERIE_PATH  # pyright: ignore

        if name not in registry.ALL_ENVS:
            near = get_close_matches(name, registry.ALL_ENVS, 3) or dm_control_suite.ALL_ENVS
            raise ValueError(f"Playground has no {name}, but {', '.join(near)}")
        if name not in dm_control_suite.ALL_ENVS and not MENAGERIE_PATH.exists():
            raise ValueError(f"its robot is in {MENAGERIE_PATH}, which Playground would download")
        config: Any = registry.get_default_config(name).lock()  # refuses unknown names
        impl = {"mjx": "jax", "mjx-warp": "warp"}[physics]
        try:
            config.update_from_flattened_dict({"impl": impl, **parameters})
        except (AttributeError, KeyError, TypeError) as reason:
            raise ValueError(f"its configuration is {', '.join(config)}: {reason}") from reason
        env = registry.load(name, config)
    return PlaygroundTask(env, physics, config.episode_length, config.action_repeat)
