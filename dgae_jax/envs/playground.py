"""Tasks of MuJoCo Playground under our trainer, unchanged, on MuJoCo MJX."""

import warnings
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.wrappers.training import EpisodeWrapper
from jaxtyping import Array, Float

from dgae_jax.envs.base import Env, State
from dgae_jax.physics.native import silence_warnings
from dgae_jax.physics.registry import require

IMPL = {"mjx": "jax", "mjx-warp": "warp"}
"""What our engines are called as an implementation of MJX."""


class PlaygroundTask(Env):
    """A task of Playground's with its own time limit and action repeat, as Playground's trainers wrap it: a truncation is in `info`.

    Of several observations the policy takes the one that is named `state`. Actions lie in [−1, 1].
    """

    def __init__(self, env: Any, physics: str, episode_length: int, action_repeat: int):
        self._env, self._physics = EpisodeWrapper(env, episode_length, action_repeat), physics
        self._action_size = env.action_size
        shape = getattr(
            _policy_sees(jax.eval_shape(env.reset, jax.random.key(0)).obs), "shape", None
        )
        if shape is None or len(shape) != 1:
            raise ValueError(
                "its observations must be one array with one axis, or have one of that kind that is named state"
            )
        self._observation_size = shape[0]

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return self._observation_size

    @property
    def action_size(self) -> int:
        """Length of the action."""
        return self._action_size

    @property
    def action_range(self) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
        """The lowest and highest action."""
        return -jnp.ones(self._action_size), jnp.ones(self._action_size)

    @property
    def backend(self) -> str:
        """Name of the physics."""
        return self._physics

    def reset(self, rng: Array) -> State:
        """A fresh episode; `pipeline_state` is Playground's state."""
        return _state(self._env.reset(rng))

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """One control interval, or as many as the task repeats an action."""
        return _state(self._env.step(state.pipeline_state, action))  # pyright: ignore[reportArgumentType]


def _policy_sees(obs: Any) -> Any:
    return obs.get("state") if isinstance(obs, Mapping) else obs


def _state(inner: Any) -> State:
    return State(
        inner,
        _policy_sees(inner.obs),
        inner.reward,
        inner.done,
        info={"truncation": inner.info["truncation"]},
    )


def make(name: str, physics: str, version: None, **parameters) -> Env:
    """The task that Playground calls `name`; `parameters` override its configuration.

    Raises ValueError, with the reason, for a task that does not exist, whose robot's files are not there, or that is not for us.
    """
    require(physics)
    with warnings.catch_warnings(), silence_warnings():
        warnings.simplefilter("ignore")
        from mujoco_playground import dm_control_suite, registry  # pyright: ignore[reportMissingImports]
        from mujoco_playground._src.mjx_env import MENAGERIE_PATH  # pyright: ignore[reportMissingImports]

        if name not in registry.ALL_ENVS:
            near = get_close_matches(name, registry.ALL_ENVS, 3) or dm_control_suite.ALL_ENVS
            raise ValueError(f"Playground has no {name}, but {', '.join(near)}")
        if name not in dm_control_suite.ALL_ENVS and not MENAGERIE_PATH.exists():
            raise ValueError(
                f"its robot is in mujoco_menagerie, which Playground looks for in {MENAGERIE_PATH} and would download"
            )
        config: Any = registry.get_default_config(name).lock()  # with a new name it is a mistake
        try:
            config.update_from_flattened_dict({"impl": IMPL[physics], **parameters})
        except (AttributeError, KeyError, TypeError) as reason:
            raise ValueError(f"its configuration is {', '.join(config)}: {reason}") from reason
        env = registry.load(name, config)
    return PlaygroundTask(env, physics, config.episode_length, config.action_repeat)
