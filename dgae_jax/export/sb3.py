"""A vector environment of Gymnasium's under stable-baselines3. Importing this imports stable-baselines3 (extra `bench`)."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from dgae_jax.configs.config import invalid


class Sb3VecEnv(VecEnv):
    """stable-baselines3's view of `env`, which resets in the same step, as stable-baselines3 expects.

    `infos` of a world are those of its own step; where an episode ended they hold `terminal_observation`, and
    `TimeLimit.truncated` says whether a time limit was all that ended it. Raises ValueError for another `autoreset_mode`.
    """

    def __init__(self, env: VectorEnv):
        mode = env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise invalid(
                "autoreset_mode", getattr(mode, "value", mode), AutoresetMode.SAME_STEP.value
            )
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """A fresh episode in every world, with the seeds of `seed` if it was called."""
        seeds, options = self._seeds, self._options[0]
        self._reset_seeds()
        self._reset_options()
        obs, infos = self.env.reset(seed=seeds, options=options)  # pyright: ignore[reportArgumentType]
        self.reset_infos = _of_each_world(infos, self.num_envs)
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions [N, A] for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """The step -> observations [N, O], rewards [N] in float32, dones [N], infos."""
        obs, reward, terminated, truncated, infos = self.env.step(self._actions)
        last = infos.pop("final_info", {})
        last_obs = infos.pop("final_obs", None)
        records = _of_each_world(infos, self.num_envs)
        done = terminated | truncated
        for i, record in enumerate(_of_each_world(last, self.num_envs)):
            records[i] = record if done[i] else records[i]
            records[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        for i in np.flatnonzero(done):
            records[i]["terminal_observation"] = last_obs[i]
        return obs, reward.astype(np.float32), done, records

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> list[Any]:
        """A picture of each world."""
        return list(self.env.render() or ())

    def get_attr(self, attr_name: str, indices=None) -> list[Any]:
        """An attribute of the environment, which all worlds share, once for each of `indices`."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices=None) -> None:
        """Raises NotImplementedError: worlds share all attributes."""
        raise NotImplementedError(f"{attr_name}: worlds share one environment, set it there")

    def env_method(
        self, method_name: str, *method_args, indices=None, **method_kwargs
    ) -> list[Any]:
        """Raises NotImplementedError: a world is no object of its own."""
        raise NotImplementedError(f"{method_name}: worlds share one environment, call it there")

    def env_is_wrapped(self, wrapper_class: type, indices=None) -> list[bool]:
        """No world is wrapped: wrappers go around all of them."""
        return [False for _ in self._get_indices(indices)]


def _of_each_world(infos: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Gymnasium's infos, arrays over worlds with masks, as a dictionary for each world."""
    names = [name for name in infos if f"_{name}" in infos]
    return [{name: infos[name][i] for name in names if infos[f"_{name}"][i]} for i in range(count)]
