"""A trained policy in NumPy alone: policy = Policy("policy.npz"); action = policy(obs)."""

from typing import Any

import numpy as np


class Policy:
    """Mean actions and the critic's quantiles, from the arrays of a file (a path or an open file)."""

    def __init__(self, file: Any):
        with np.load(file) as arrays:
            self.arrays = dict(arrays)

    def __call__(self, obs: Any) -> np.ndarray:
        """The action [..., A] in each observation [..., O]: the mean, within the actuators' range."""
        return np.clip(
            self._outputs("policy", obs), self.arrays["action_low"], self.arrays["action_high"]
        )

    def quantiles(self, obs: Any) -> np.ndarray:
        """The critic's quantiles [..., K] of the discounted return, K = 1 for a scalar critic, in the units it was trained in."""
        outputs = self._outputs("critic", obs)
        if "critic_count" in self.arrays:
            return np.sort(outputs)
        if "critic_steps" not in self.arrays:
            return outputs
        return (
            outputs[..., :1]
            + np.logaddexp(np.float32(0), outputs[..., 1:]) @ self.arrays["critic_steps"]
        )

    def _outputs(self, network: str, obs: Any) -> np.ndarray:
        a = self.arrays
        x = (np.asarray(obs, np.float32) - a["observation_mean"]) / a["observation_std"]
        x = np.clip(x, -a["observation_limit"], a["observation_limit"])
        hidden = sum(name.startswith(f"{network}_weight_") for name in a) - 1
        for i in range(hidden):
            x = np.tanh(x @ a[f"{network}_weight_{i}"] + a[f"{network}_bias_{i}"])
        return x @ a[f"{network}_weight_{hidden}"] + a[f"{network}_bias_{hidden}"]
