"""Generalized advantage estimation for distributional policy gradients, end to end in JAX."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # mujoco.mjx prints that it has no Warp, which is no news here
    import mujoco.mjx  # noqa: F401

from dgae_jax.configs.build import make_algorithm, make_train
from dgae_jax.configs.config import Config, ConfigError, CriticConfig, NoiseConfig, PolicyConfig
from dgae_jax.configs.presets import preset
from dgae_jax.envs.registry import make_env
from dgae_jax.maths.returns import (
    bellman_target,
    dgae,
    distributional_td_residual,
    gae,
    lambda_return,
    lambda_shift_target,
    lambda_sum,
    n_step_advantage,
    sr_lambda_target,
    td_residual,
)
from dgae_jax.maths.risk import METRICS, weights_of
from dgae_jax.maths.statistics import bootstrap_interval, coverage, crps, explained_variance, iqm, pit
from dgae_jax.maths.transport import directional_metric, quantile_huber_loss, quantile_midpoints, wasserstein

__version__ = "0.1.0"

__all__ = [
    "METRICS",
    "Config",
    "ConfigError",
    "CriticConfig",
    "NoiseConfig",
    "PolicyConfig",
    "bellman_target",
    "bootstrap_interval",
    "coverage",
    "crps",
    "dgae",
    "directional_metric",
    "distributional_td_residual",
    "explained_variance",
    "gae",
    "iqm",
    "lambda_return",
    "lambda_shift_target",
    "lambda_sum",
    "make_algorithm",
    "make_env",
    "make_train",
    "n_step_advantage",
    "pit",
    "preset",
    "quantile_huber_loss",
    "quantile_midpoints",
    "sr_lambda_target",
    "td_residual",
    "wasserstein",
    "weights_of",
]
