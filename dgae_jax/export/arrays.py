"""A trained policy and its critic as plain arrays by name: the content of every exported file.

- `policy_weight_I` [inputs, outputs], `policy_bias_I`: layers, first to last, tanh between them.
  `critic_weight_I` and `critic_bias_I` likewise.
- `critic_steps` [K - 1, K] of an ordered critic: its first output is the mean of its quantiles, to
  which softplus(the others) @ `critic_steps` is added.
- `critic_count` [1] of a sorted critic: its quantiles are its K outputs, sorted.
- Observations are normalized first: (obs - `observation_mean`) / `observation_std`, clipped to
  ± `observation_limit`.
- Actions are clipped to `action_low` … `action_high`.
- `env` is Gymnasium's id of the task, `episode_length` its time limit.
"""

import io
from functools import partial
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.export.templates.policy import Policy as NumpyPolicy
from dgae_jax.learn.build import make_task
from dgae_jax.learn.normalizers import OBSERVATION_LIMIT
from dgae_jax.learn.types import InferenceState
from dgae_jax.maths.transport import GAP_BIAS, centered_cumsum
from dgae_jax.run.api import Policy
from dgae_jax.run.checkpoint import Networks
from dgae_jax.run.episodes import time_limit
from dgae_jax.run.options import eval_env_id

Arrays = dict[str, np.ndarray]


def arrays_of(found: Networks, config: ResolvedConfig, index: int) -> Arrays:
    """Return the arrays of one of the policies that were trained together.

    Raises:
        ConfigError: the arrays do not compute what the policy does, as its networks are custom.
    """
    policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
    try:
        arrays = _arrays(policy, critic, config)
        _compare(arrays, Policy(policy, critic, config))
    except (KeyError, ValueError, AssertionError) as reason:
        message = f"{found.path}: only networks of dgae_jax can be exported ({reason})"
        raise ConfigError(message) from reason
    return arrays


def _arrays(policy: InferenceState, critic: InferenceState, config: ResolvedConfig) -> Arrays:
    env, statistics = make_task(config), policy.obs_stats
    arrays = {**_layers("policy", policy.params), **_layers("critic", critic.params)}
    if config.critic.kind == "ordered":
        arrays |= _ordered(arrays)
    elif config.critic.kind == "sorted":
        arrays["critic_count"] = np.array([config.critic.outputs])
    size = int(env.observation_size)  # pyright: ignore[reportArgumentType]
    mean, std, limit = np.zeros(size), np.ones(size), np.inf
    if statistics is not None:
        mean, std, limit = statistics.mean, statistics.std, OBSERVATION_LIMIT
    low, high = env.action_range
    values = {"observation_mean": mean, "observation_std": std, "observation_limit": limit}
    values |= {"action_low": low, "action_high": high}
    arrays |= {name: np.asarray(value, np.float32) for name, value in values.items()}
    task = {"env": np.array(eval_env_id(config)), "episode_length": np.array(time_limit(config))}
    return arrays | task


def to_npz(arrays: Arrays) -> bytes:
    """Return the bytes of a `.npz` file."""
    file = io.BytesIO()
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def _layers(network: str, params: Any) -> Arrays:
    """Return the torso's layers and the head of a module of `learn.networks`."""
    torso, head = (params["params"].get(name, {}) for name in ("Torso_0", "Dense_0"))
    arrays = {}
    for i, layer in enumerate([*(torso[f"Dense_{i}"] for i in range(len(torso))), head]):
        arrays[f"{network}_weight_{i}"] = np.asarray(layer["kernel"])
        arrays[f"{network}_bias_{i}"] = np.asarray(layer["bias"])
    return arrays


def _ordered(layers: Arrays) -> Arrays:
    """Return the last bias and the matrix that make outputs quantiles (`monotone_quantiles`)."""
    last = [name for name in layers if name.startswith("critic_bias_")][-1]
    bias = layers[last] - np.float32(GAP_BIAS) * (np.arange(layers[last].size) > 0)
    return {
        last: bias.astype(np.float32),
        "critic_steps": np.asarray(centered_cumsum(bias.size), np.float32),
    }


def _compare(arrays: Arrays, policy: Policy) -> None:
    exported = NumpyPolicy(io.BytesIO(to_npz(arrays)))
    noise = np.random.default_rng(0).normal(size=(100, policy.observation_size))
    obs = arrays["observation_mean"] + 3 * noise * arrays["observation_std"]
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    close(exported(obs), policy(obs), err_msg="actions differ")
    close(exported.quantiles(obs), policy.quantiles(obs), err_msg="quantiles differ")
