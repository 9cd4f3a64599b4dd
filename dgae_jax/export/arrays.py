"""A trained policy and its critic as plain arrays by name, all that is needed to act: what every exported file is made of.

`policy_weight_I` [inputs, outputs] and `policy_bias_I` are the layers from the first to the last, likewise the critic's; tanh stands
between layers. Where there is `critic_steps` [K - 1, K], the critic's first output is the mean of its quantiles, to which
log(1 + exp(the others)) @ `critic_steps` is added; where there is `critic_count` [1], its quantiles are its K outputs, sorted.
Observations are normalised before: (obs - `observation_mean`) / `observation_std`, clipped to ± `observation_limit`. Actions are
clipped to `action_low` … `action_high`. `env` is Gymnasium's name of the task, `episode_length` its time limit.
"""

import io
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.export.outside import policy as outside
from dgae_jax.learn.build import make_task
from dgae_jax.learn.normalizers import OBSERVATION_LIMIT
from dgae_jax.maths.transport import GAP_BIAS, centered_cumsum
from dgae_jax.run.api import Policy
from dgae_jax.run.checkpoint import Networks
from dgae_jax.run.evaluation import time_limit
from dgae_jax.run.options import eval_env_id

Arrays = dict[str, np.ndarray]

TOLERANCE = 1e-4
"""Largest difference between the arrays' outputs and those of the policy itself, absolute and relative."""


def arrays_of(found: Networks, config: ResolvedConfig, index: int) -> Arrays:
    """The arrays of one of the seeds trained side by side.

    Raises ConfigError if they do not do what the policy does, because a part of its networks is of another make.
    """
    policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
    env = make_task(config)
    low, high = env.action_range
    try:
        layers = {**_layers("policy", policy.params), **_layers("critic", critic.params)}
        if config.critic.kind == "ordered":
            layers |= _in_order(layers)
        elif config.critic.kind == "sorted":
            layers["critic_count"] = np.array([config.critic.outputs])
    except KeyError as name:
        raise _foreign(found, f"{name} is missing") from name
    arrays = {
        **_normaliser(policy.obs_stats, int(env.observation_size)),  # pyright: ignore[reportArgumentType]
        **layers,
        "action_low": np.asarray(low, np.float32),
        "action_high": np.asarray(high, np.float32),
        "env": np.array(eval_env_id(config)),
        "episode_length": np.array(time_limit(config)),
    }
    _compare(arrays, Policy(policy, critic, config), found)
    return arrays


def packed(arrays: Arrays) -> bytes:
    """The arrays as the bytes of a file `.npz`."""
    file = io.BytesIO()
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def _normaliser(statistics: Any, size: int) -> Arrays:
    """Without statistics, one that changes nothing."""
    values = (np.zeros(size), np.ones(size), np.inf)
    if statistics is not None:
        values = (statistics.mean, statistics.std, OBSERVATION_LIMIT)
    names = ("observation_mean", "observation_std", "observation_limit")
    return {name: np.asarray(value, np.float32) for name, value in zip(names, values, strict=True)}


def _layers(network: str, params: Any) -> Arrays:
    """Of the modules in `learn.networks`: the layers of the torso, then the head, which is the policy's mean."""
    torso, head = (params["params"].get(name, {}) for name in ("Torso_0", "Dense_0"))
    layers = [*(torso[f"Dense_{i}"] for i in range(len(torso))), head]
    parts = {"weight": "kernel", "bias": "bias"}
    return {
        f"{network}_{ours}_{i}": np.asarray(layer[name])
        for i, layer in enumerate(layers)
        for ours, name in parts.items()
    }


def _in_order(layers: Arrays) -> Arrays:
    """What makes the critic's outputs quantiles in order (`maths.transport.monotone_quantiles`): its last bias, and the matrix of the steps."""
    last = [name for name in layers if name.startswith("critic_bias_")][-1]
    narrow = layers[last] - np.float32(GAP_BIAS) * (np.arange(layers[last].size) > 0)
    return {
        last: narrow.astype(np.float32),
        "critic_steps": np.asarray(centered_cumsum(narrow.size), np.float32),
    }


def _compare(arrays: Arrays, policy: Policy, found: Networks) -> None:
    ours = outside.Policy(io.BytesIO(packed(arrays)))
    spread = np.random.default_rng(0).normal(size=(100, policy.observation_size))
    obs = arrays["observation_mean"] + 3 * spread * arrays["observation_std"]
    try:
        outputs = {
            "actions": (ours(obs), policy(obs)),
            "quantiles": (ours.quantiles(obs), policy.quantiles(obs)),
        }
    except ValueError as reason:
        raise _foreign(found, "as plain layers they do not fit together") from reason
    for name, (a, b) in outputs.items():
        if a.shape != b.shape or not np.allclose(a, b, rtol=TOLERANCE, atol=TOLERANCE):
            raise _foreign(found, f"as plain layers their {name} differ")


def _foreign(found: Networks, why: str) -> ConfigError:
    return ConfigError(
        f"{found.path}: must have networks of dgae_jax's own make to be exported; {why}"
    )
