from .configs.config import Config, ConfigError, CriticConfig, NoiseConfig, PolicyConfig
from .configs.presets import preset
from .configs.resolved import ResolvedConfig, resolve
from .envs.registry import make_env
from .export.vector import make_vector_env
from .learn.build import make_algorithm, register
from .learn.iteration import make_train
from .maths.returns import (
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
from .maths.risk import METRICS, weights_of
from .maths.statistics import bootstrap_interval, coverage, crps, explained_variance, iqm, pit
from .maths.transport import (
    directional_metric,
    quantile_huber_loss,
    quantile_midpoints,
    wasserstein,
)
from .run.api import Run, load_policy, train
from .run.checkpoint import CheckpointError
from .run.training import RunError

__version__: str

__all__ = [
    "METRICS",
    "CheckpointError",
    "Config",
    "ConfigError",
    "CriticConfig",
    "NoiseConfig",
    "PolicyConfig",
    "ResolvedConfig",
    "Run",
    "RunError",
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
    "load_policy",
    "make_algorithm",
    "make_env",
    "make_train",
    "make_vector_env",
    "n_step_advantage",
    "pit",
    "preset",
    "quantile_huber_loss",
    "quantile_midpoints",
    "register",
    "resolve",
    "sr_lambda_target",
    "td_residual",
    "train",
    "wasserstein",
    "weights_of",
]
