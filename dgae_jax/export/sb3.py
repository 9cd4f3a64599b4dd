"""Adapter from a Gymnasium vector env to stable-baselines3, which must be installed."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from dgae_jax.configs.config import invalid


class Sb3VecEnv(VecEnv):
    """A stable-baselines3 `VecEnv` over `env`.

    Infos are those of an env's own step. At the end of an episode they hold `terminal_observation`
    and `TimeLimit.truncated`, true if only a time limit ended it.
    """

    def __init__(self, env: VectorEnv):
        """Wrap a vector env with `autoreset_mode` SameStep, as stable-baselines3 expects."""
        mode = env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise invalid("autoreset_mode", getattr(mode, "value", mode), "SameStep")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """Begin an episode in every env, with the seeds of `seed` if it was called."""
        seeds: Any = self._seeds
        obs, infos = self.env.reset(seed=seeds, options=self._options[0])
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = _per_env(infos, self.num_envs)
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions [N, A] for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Take the step: observations [N, O], rewards [N] in float32, dones [N], infos."""
        obs, reward, terminated, truncated, infos = self.env.step(self._actions)
        final_infos = _per_env(infos.pop("final_info", {}), self.num_envs)
        final_obs = infos.pop("final_obs", None)
        records, done = _per_env(infos, self.num_envs), terminated | truncated
        for i in range(self.num_envs):
            if done[i]:
                records[i] = final_infos[i] | {"terminal_observation": final_obs[i]}
            records[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return obs, reward.astype(np.float32), done, records

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> list[Any]:
        """Return a picture of each env."""
        return list(self.env.render() or ())

    def get_attr(self, attr_name: str, indices=None) -> list[Any]:
        """Return an attribute, which all envs share, once for each of `indices`."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices=None) -> list[bool]:
        """Return False for each env: wrappers go around all of them."""
        return [False for _ in self._get_indices(indices)]

    def env_method(self, method_name: str, *_, **__) -> list[Any]:
        """Raise NotImplementedError: no env is an object of its own."""
        raise NotImplementedError(f"{method_name}: all envs share those of `env`")

    set_attr = env_method


def _per_env(infos: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Turn Gymnasium's infos, arrays with masks, into a dictionary per env."""
    names = [name for name in infos if f"_{name}" in infos]
    return [{name: infos[name][i] for name in names if infos[f"_{name}"][i]} for i in range(count)]
