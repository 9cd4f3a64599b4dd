"""Critics are a network, a target and a distance: scalar values are the case of one quantile and a squared distance."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dgae_jax.learn.networks import value_network
from dgae_jax.learn.types import Batch, Critic, Params, Part
from dgae_jax.maths.returns import (
    bellman_target,
    distributional_td_residual,
    lambda_return,
    lambda_shift_target,
    sr_lambda_target,
    td_residual,
)
from dgae_jax.maths.transport import quantile_huber_loss


class Target(NamedTuple):
    """What a critic is fitted to."""

    frozen: Callable
    """`frozen(key, reward, discount, trace, quantiles, next_quantiles)`, once per iteration."""
    during: Callable
    """`during(predict, params, batch)`, at every gradient step."""


def _keep(predict, params: Params, batch: Batch) -> Array:
    return batch.target


def _follow(predict, params: Params, batch: Batch) -> Array:
    """𝒯G with the critic as it is now, through which no gradient flows."""
    return bellman_target(batch.reward, batch.discount, jax.lax.stop_gradient(predict(params, batch.next_obs)))


def _one_step(key, reward, discount, trace, quantiles, next_quantiles):
    return bellman_target(reward, discount, next_quantiles)


TARGETS = {
    "bellman": Target(_one_step, _follow),
    "bellman-frozen": Target(_one_step, _keep),
    "lambda-shift": Target(lambda key, *step: lambda_shift_target(*step), _keep),
    "sr-lambda": Target(lambda key, r, d, t, z, z_next: sr_lambda_target(key, r, d, t, z_next), _keep),
    "lambda-return": Target(lambda key, *step: lambda_return(*step), _keep),
}


def _critic(obs_size: int, outputs: int, hidden: Sequence[int], target: str, distance: Callable) -> Critic:
    network, fitted_to = value_network(obs_size, outputs, hidden=hidden), TARGETS[target]

    def loss(params: Params, batch: Batch):
        target = fitted_to.during(network.apply, params, batch)
        return jnp.where(batch.sound, distance(network.apply(params, batch.obs), target), 0).mean(), {}

    return Critic(network.init, network.apply, fitted_to.frozen, loss)


def scalar(obs_size: int, *, hidden: Sequence[int], target: str) -> Critic:
    """V(s), fitted by half the squared error."""

    def distance(value: Float[Array, "B 1"], target: Float[Array, "B 1"]) -> Float[Array, " B"]:
        return 0.5 * ((value - target) ** 2).mean(-1)

    return _critic(obs_size, 1, hidden, target, distance)


def quantile(obs_size: int, *, hidden: Sequence[int], target: str, quantiles: int, kappa: ArrayLike) -> Critic:
    """F⁻¹ of the return at K midpoints, fitted by the quantile-Huber loss (Eq. quantile_huber_loss)."""

    def distance(quantiles: Float[Array, "B K"], target: Float[Array, "B J"]) -> Float[Array, " B"]:
        return quantile_huber_loss(quantiles, target, kappa=kappa)

    return _critic(obs_size, quantiles, hidden, target, distance)


CRITICS = {"scalar": Part(scalar), "quantile": Part(quantile, ("quantiles", "kappa"))}
"""What a critic predicts: `build(obs_size, hidden=, target=, **options) -> Critic`."""


def _of_means(weights):
    return lambda reward, discount, z, z_next: td_residual(reward, discount, z.mean(-1), z_next.mean(-1))


def _of_distributions(weights):
    return lambda reward, discount, z, z_next: distributional_td_residual(reward, discount, z, z_next, weights)


RESIDUALS = {"td": Part(_of_means), "distributional": Part(_of_distributions, ("metric",))}
"""How two predictions become one number: `build(weights of the metric) -> residual(reward, discount, z, z_next)`."""
