"""Names of the parts of an algorithm, and the settings that each takes with their defaults.

The functions behind the names are in tables of the same names in `learn` (`learn.updates.UPDATES`,
`learn.critics.CRITICS`, …). `learn.build.register` adds a part of your own to both.
"""

from collections.abc import Mapping
from typing import Any

Defaults = Mapping[str, Any]
"""Settings of a part and their defaults: fields of `PolicyConfig` or `CriticConfig`."""

SGD: Defaults = {
    "optimizer": "adam",
    "learning_rate": 3e-4,
    "learning_rate_end": 0.0,
    "epochs": 10,
    "minibatches": 32,
    "max_grad_norm": 0.5,
}
"""Minibatch gradient descent, by which every critic and most policies are fitted."""

UPDATES: dict[str, Defaults] = {
    "clip": {"clip_eps": 0.2, **SGD},
    "gradient": SGD,
    "trust-region": {
        "max_kl": 0.01,
        "learning_rate_end": 1.0,
        "damping": 0.1,
        "cg_iterations": 10,
        "max_backtracks": 10,
        "fisher_every": 1,
    },
}

CRITICS: dict[str, Defaults] = {
    "scalar": {},
    "quantile": {"quantiles": 64, "kappa": 1.0},
    "sorted": {"quantiles": 64, "kappa": 1.0},
    "ordered": {"quantiles": 64, "kappa": 1e-4},
}

_TARGETS = "bellman", "bellman-frozen", "lambda-shift", "sr-lambda", "lambda-return", "monte-carlo"
TARGETS: dict[str, Defaults] = {name: {} for name in _TARGETS}
RESIDUALS: dict[str, Defaults] = {"td": {}, "distributional": {}}
COVARIANCES: dict[str, Defaults] = {"shared": {}, "state": {}}
OPTIMIZERS: dict[str, Defaults] = {"adam": {}, "rmsprop": {}}
