"""The table: an algorithm's name is a row of parts, and nothing else depends on the name."""

from collections.abc import Callable
from typing import NamedTuple

from dgae_jax import critics
from dgae_jax.returns import distributional_td_residual, td_residual


class Row(NamedTuple):
    """What distinguishes one name from another."""

    critic: Callable
    """Builds the critic: `critics.scalar` or `critics.quantile`."""
    critic_options: tuple[str, ...]
    """The critic's settings beside hidden layers and target."""
    residual: Callable
    """The one thing DGAE changes: how two value predictions become one number."""
    target: str
    """The critic target used unless another is asked for."""


def scalar_residual(reward, discount, value, next_value):
    """The TD error of a critic with one output, [..., 1]."""
    return td_residual(reward, discount, value[..., 0], next_value[..., 0])


TABLE = {
    "ppo": Row(critics.scalar, (), scalar_residual, "lambda-return"),
    "dppo": Row(critics.quantile, ("quantiles", "kappa"), distributional_td_residual, "sr-lambda"),
}
