"""A trained policy in NumPy alone: policy = Policy("policy.npz"); action = policy(obs)."""

from typing import Any

import numpy as np


class Policy:
    """Mean actions and the critic's quantiles."""

    def __init__(self, file: Any):
        """Load the arrays of `file`, a path or an open binary file."""
        with np.load(file) as arrays:
            self.arrays = dict(arrays)

    def __call__(self, obs: Any) -> np.ndarray:
        """Return mean actions [..., A], within the actuators' range, for obs [..., O]."""
        mean = self._network("policy", obs)
        return np.clip(mean, self.arrays["action_low"], self.arrays["action_high"])

    def quantiles(self, obs: Any) -> np.ndarray:
        """Return the critic's quantiles [..., K] of the discounted return; a scalar one has 1."""
        outputs = self._network("critic", obs)
        if "critic_count" in self.arrays:
            return np.sort(outputs)
        if "critic_steps" not in self.arrays:
            return outputs
        gaps = np.logaddexp(np.float32(0), outputs[..., 1:])
        return outputs[..., :1] + gaps @ self.arrays["critic_steps"]

    def _network(self, name: str, obs: Any) -> np.ndarray:
        a = self.arrays
        x = (np.asarray(obs, np.float32) - a["observation_mean"]) / a["observation_std"]
        x = np.clip(x, -a["observation_limit"], a["observation_limit"])
        last = sum(key.startswith(f"{name}_weight_") for key in a) - 1
        for i in range(last):
            x = np.tanh(x @ a[f"{name}_weight_{i}"] + a[f"{name}_bias_{i}"])
        return x @ a[f"{name}_weight_{last}"] + a[f"{name}_bias_{last}"]
