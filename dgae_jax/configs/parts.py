"""The parts that a configuration names: where each is built, and the settings it takes with their defaults.

Builders are written `module:function` and imported when they are used, so that names and settings are checked before JAX is
loaded. A part of your own joins its table, with the thing itself in place of its name (docs/python.md).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import Any


@dataclass(frozen=True)
class Part:
    """An entry of a table of parts."""

    builder: str | Any
    """`module:name`, or the thing itself: a function, or what the table says."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """The settings it is built with, with their defaults; it does not use any other of its group."""

    @property
    def build(self) -> Any:
        """The thing itself."""
        return resolve_name(self.builder) if isinstance(self.builder, str) else self.builder


DESCENT = {"optimizer": "adam", "learning_rate": 3e-4, "learning_rate_end": 0.0, "epochs": 10, "minibatches": 32, "max_grad_norm": 0.5}
"""Settings of gradient descent by minibatches, which fits every critic and most policies."""

_TRUST_REGION = {"radius": 0.01, "learning_rate_end": 1.0, "damping": 0.1, "cg_iterations": 10, "backtracks": 10, "fisher_every": 1}

UPDATES = {
    "clip": Part("dgae_jax.learn.updates:clipped", {"clip": 0.2, **DESCENT}),
    "gradient": Part("dgae_jax.learn.updates:policy_gradient", DESCENT),
    "trust-region": Part("dgae_jax.learn.updates:natural_gradient", _TRUST_REGION),
}
"""How a policy improves: `build(policy, iterations, **options) -> Update`."""

CRITICS = {
    "scalar": Part("dgae_jax.learn.critics:scalar"),
    "quantile": Part("dgae_jax.learn.critics:quantile", {"quantiles": 64, "kappa": 1.0}),
    "sorted": Part("dgae_jax.learn.critics:sorted_quantile", {"quantiles": 64, "kappa": 1.0}),
    "ordered": Part("dgae_jax.learn.critics:ordered", {"quantiles": 64, "kappa": 1e-4}),
}
"""What a critic predicts: `build(obs_size, hidden=, target=, **options) -> Critic`."""


def is_distribution(critic: str) -> bool:
    """Whether a critic of this name predicts a distribution, because it has quantiles."""
    return "quantiles" in CRITICS[critic].options


TARGETS = {
    "bellman": Part("dgae_jax.learn.critics:BELLMAN"),
    "bellman-frozen": Part("dgae_jax.learn.critics:BELLMAN_FROZEN"),
    "lambda-shift": Part("dgae_jax.learn.critics:LAMBDA_SHIFT"),
    "sr-lambda": Part("dgae_jax.learn.critics:SR_LAMBDA"),
    "lambda-return": Part("dgae_jax.learn.critics:LAMBDA_RETURN"),
    "monte-carlo": Part("dgae_jax.learn.critics:MONTE_CARLO"),
}
"""What a critic is fitted to: a `Target`."""

RESIDUALS = {"td": Part("dgae_jax.learn.critics:td"), "distributional": Part("dgae_jax.learn.critics:distributional")}
"""How two predictions become one number: `build(weights of the metric) -> residual(reward, discount, z, z_next)`."""

COVARIANCES = {"shared": Part("dgae_jax.learn.networks:SharedCovariance"), "state": Part("dgae_jax.learn.networks:StateCovariance")}
"""The policy's network, by where its covariance comes from: a flax module of `hidden`, `actions`, `initial_std` that gives a Gaussian."""

OPTIMIZERS = {"adam": Part("dgae_jax.learn.updates:adam"), "rmsprop": Part("dgae_jax.learn.updates:rmsprop")}
"""How a gradient becomes a step: `build(learning rate or schedule) -> optax.GradientTransformation`."""
