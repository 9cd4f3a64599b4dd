"""Critics are a network, a target and a distance: scalar values are the case of one quantile and a squared distance."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dgae_jax.learn.networks import Torso, value_network
from dgae_jax.learn.types import Batch, Critic, Params
from dgae_jax.maths.returns import (
    bellman_target,
    distributional_td_residual,
    lambda_return,
    lambda_shift_target,
    sr_lambda_target,
    td_residual,
)
from dgae_jax.maths.transport import in_order, quantile_huber_loss


class Target(NamedTuple):
    """The target of a critic's fit."""

    compute: Callable
    """`compute(key, reward, discount, trace, quantiles, next_quantiles) -> [T, N, J]`, one signature for all."""
    recompute: bool = False
    """Whether it is computed at every gradient step with the current critic, or once per iteration with the critic that acted.

    Only for one-step targets: a shuffled minibatch has neither key nor trace, which are None then, as are the quantiles.
    """
    lam: float | None = None
    """λ of the trace where it is not that of the advantages."""


def _bellman(key, reward, discount, trace, quantiles, next_quantiles):
    return bellman_target(reward, discount, next_quantiles)


def _lambda_shift(key, reward, discount, trace, quantiles, next_quantiles):
    return lambda_shift_target(reward, discount, trace, quantiles, next_quantiles)


def _sr_lambda(key, reward, discount, trace, quantiles, next_quantiles):
    return sr_lambda_target(key, reward, discount, trace, next_quantiles)


def _lambda_return(key, reward, discount, trace, quantiles, next_quantiles):
    return lambda_return(reward, discount, trace, quantiles, next_quantiles)[..., None]


BELLMAN = Target(_bellman, recompute=True)
BELLMAN_FROZEN = Target(_bellman)
LAMBDA_SHIFT = Target(_lambda_shift)
SR_LAMBDA = Target(_sr_lambda)
MONTE_CARLO = Target(_sr_lambda, lam=1.0)
LAMBDA_RETURN = Target(_lambda_return)


def _critic(
    obs_size: int, outputs: int, hidden: Sequence[int], torso: Callable, target: Target, distance: Callable, head: Callable = jnp.asarray
) -> Critic:
    network = value_network(obs_size, outputs, hidden=hidden, torso=torso)

    def predict(params: Params, obs: Array) -> Array:
        return head(network.apply(params, obs))

    def fitted_to(params: Params, batch: Batch) -> Array:
        if not target.recompute:
            return batch.target
        following = jax.lax.stop_gradient(predict(params, batch.next_obs))
        return target.compute(None, batch.reward, batch.discount, None, None, following)

    def loss(params: Params, batch: Batch):
        apart = distance(predict(params, batch.obs), fitted_to(params, batch), batch.value)
        return jnp.where(batch.valid, apart, 0).mean(), {}

    return Critic(network.init, predict, target.compute, loss, target.lam)


def scalar(obs_size: int, *, hidden: Sequence[int], target: Target, torso: Callable = Torso) -> Critic:
    """V(s), fitted by half the squared error; `torso` is the flax module of its `hidden` layers."""

    def distance(value: Float[Array, "B 1"], target: Float[Array, "B 1"], before: Float[Array, " B"]) -> Float[Array, " B"]:
        return 0.5 * ((value - target) ** 2).mean(-1)

    return _critic(obs_size, 1, hidden, torso, target, distance)


def quantile(obs_size: int, *, hidden: Sequence[int], target: Target, quantiles: int, kappa: ArrayLike, torso: Callable = Torso) -> Critic:
    """F⁻¹ of the return at K midpoints, fitted by the quantile-Huber loss (Eq. quantile_huber_loss); `torso` as for `scalar`."""

    def distance(quantiles: Float[Array, "B K"], target: Float[Array, "B J"], before: Float[Array, " B"]) -> Float[Array, " B"]:
        return quantile_huber_loss(quantiles, target, kappa=kappa)

    return _critic(obs_size, quantiles, hidden, torso, target, distance)


def sorted_quantile(obs_size: int, **options) -> Critic:
    """`quantile`, whose outputs are sorted where they are used, which takes them as a whole no farther from the truth (Chernozhukov et
    al. 2010).
    """
    plain = quantile(obs_size, **options)
    return plain._replace(predict=lambda params, obs: jnp.sort(plain.predict(params, obs)))


_OF_SHAPE = 1 / 64
"""Weight of the shape beside the mean, small so as to leave the layers that both share to the mean."""


def ordered(obs_size: int, *, hidden: Sequence[int], target: Target, quantiles: int, kappa: ArrayLike, torso: Callable = Torso) -> Critic:
    """F⁻¹ of the return at K midpoints `in_order`: their mean is fitted by half the squared error, and their shape to how far
    the targets lie from the mean that was predicted before the rollout was learned from, by the quantile-Huber loss over κ (Dabney et
    al. 2018); `torso` as for `scalar`.
    """

    def distance(quantiles: Float[Array, "B K"], target: Float[Array, "B J"], before: Float[Array, " B"]) -> Float[Array, " B"]:
        mean = quantiles.mean(-1)
        shape = quantile_huber_loss(quantiles - mean[:, None], target - before[:, None], kappa=kappa) / kappa
        scale = quantiles.shape[-1] / 2  # of the quantile-Huber loss of K equal quantiles, Σᵢ τ̂ᵢ
        return scale * 0.5 * (mean - target.mean(-1)) ** 2 + _OF_SHAPE * shape

    return _critic(obs_size, quantiles, hidden, torso, target, distance, head=in_order)


def td(weights: ArrayLike | None) -> Callable[..., Array]:
    """The scalar residual, of the means (below Eq. GAE); no metric."""
    return lambda reward, discount, z, z_next: td_residual(reward, discount, z.mean(-1), z_next.mean(-1))


def distributional(weights: ArrayLike | None) -> Callable[..., Array]:
    """The distributional residual under the metric of these weights (Def. distributional_TD_error)."""
    return lambda reward, discount, z, z_next: distributional_td_residual(reward, discount, z, z_next, weights)
