"""Critics: a network, a target and a loss. A scalar critic is one quantile and a squared error."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dgae_jax.learn.networks import Torso, Value, network
from dgae_jax.learn.types import Batch, Critic, Params, Residual, TargetFn
from dgae_jax.maths.returns import (
    bellman_target,
    distributional_td_residual,
    lambda_return,
    lambda_shift_target,
    sr_lambda_target,
    td_residual,
)
from dgae_jax.maths.transport import monotone_quantiles, quantile_huber_loss


class Target(NamedTuple):
    """The target of a critic's fit."""

    compute: TargetFn
    recompute: bool = False
    """True to compute it at every gradient step with the current critic; False to compute it once
    per iteration with the critic at rollout time. Only for one-step targets: `compute` then gets
    key = trace = quantiles = None, since minibatches are shuffled."""
    lam: float | None = None
    """λ of the trace where it differs from that of the advantages."""


def _bellman(key, reward, discount, trace, quantiles, next_quantiles):
    return bellman_target(reward, discount, next_quantiles)


def _lambda_shift(key, reward, discount, trace, quantiles, next_quantiles):
    return lambda_shift_target(reward, discount, trace, quantiles, next_quantiles)


def _sr_lambda(key, reward, discount, trace, quantiles, next_quantiles):
    return sr_lambda_target(key, reward, discount, trace, next_quantiles)


def _lambda_return(key, reward, discount, trace, quantiles, next_quantiles):
    return lambda_return(reward, discount, trace, quantiles, next_quantiles)[..., None]


TARGETS: dict[str, Target] = {
    "bellman": Target(_bellman, recompute=True),
    "bellman-frozen": Target(_bellman),
    "lambda-shift": Target(_lambda_shift),
    "sr-lambda": Target(_sr_lambda),
    "lambda-return": Target(_lambda_return),
    "monte-carlo": Target(_sr_lambda, lam=1.0),
}

Error = Callable[[Array, Array, Array], Float[Array, " B"]]
"""`error(quantiles [B, K], target [B, J], value [B]) -> [B]`: loss of each sample."""


def _critic(
    obs_size: int,
    outputs: int,
    error: Error,
    *,
    hidden: Sequence[int],
    target: Target,
    torso: Callable[[Sequence[int]], nn.Module] = Torso,
    head: Callable[[Array], Array] = jnp.asarray,
) -> Critic:
    values = network(Value(hidden, outputs, torso), obs_size)

    def predict(params: Params, obs: Array) -> Array:
        return head(values.apply(params, obs))

    def target_of(params: Params, batch: Batch) -> Array:
        if not target.recompute:
            return batch.target
        next_quantiles = jax.lax.stop_gradient(predict(params, batch.next_obs))
        return target.compute(None, batch.reward, batch.discount, None, None, next_quantiles)

    def loss(params: Params, batch: Batch):
        errors = error(predict(params, batch.obs), target_of(params, batch), batch.value)
        return jnp.where(batch.mask, errors, 0).mean(), {}

    return Critic(values.init, predict, target.compute, loss, target.lam)


def scalar_critic(obs_size: int, **network) -> Critic:
    """Build V(s), fitted by half the squared error; `network` as in `quantile_critic`."""

    def error(value: Array, target: Array, before: Array) -> Float[Array, " B"]:
        return 0.5 * ((value - target) ** 2).mean(-1)

    return _critic(obs_size, 1, error, **network)


def quantile_critic(obs_size: int, *, quantiles: int, kappa: ArrayLike, **network) -> Critic:
    """Build F⁻¹ of the return at K midpoints, fitted by the quantile-Huber loss.

    Args:
        obs_size: length of an observation.
        quantiles: their number K.
        kappa: threshold κ of the loss (Eq. quantile_huber_loss).
        network: `hidden`, widths of the hidden layers; `target` of the fit; optionally `torso`,
            flax module of the `hidden` layers.
    """

    def error(quantiles: Array, target: Array, before: Array) -> Float[Array, " B"]:
        return quantile_huber_loss(quantiles, target, kappa=kappa)

    return _critic(obs_size, quantiles, error, **network)


def sorted_critic(obs_size: int, **options) -> Critic:
    """Build `quantile_critic` with sorted predictions.

    Sorting takes a distribution no farther from the truth (Chernozhukov et al. 2010).
    """
    unsorted = quantile_critic(obs_size, **options)
    return unsorted._replace(predict=lambda params, obs: jnp.sort(unsorted.predict(params, obs)))


SHAPE_LOSS_WEIGHT = 1 / 64
"""Small, so that the layers that both share are left to the mean."""


def ordered_critic(obs_size: int, *, quantiles: int, kappa: ArrayLike, **network) -> Critic:
    """Build F⁻¹ of the return at K `monotone_quantiles`; arguments as `quantile_critic`.

    The mean is fitted by half the squared error. The shape is fitted to how far the targets lie
    from the value estimate at rollout time, by the quantile-Huber loss over κ (Dabney et al. 2018).
    """

    def error(quantiles: Array, target: Array, before: Array) -> Float[Array, " B"]:
        mean = quantiles.mean(-1)
        about, target_about = quantiles - mean[:, None], target - before[:, None]
        shape = quantile_huber_loss(about, target_about, kappa=kappa) / kappa
        scale = quantiles.shape[-1] / 2  # of the quantile-Huber loss of K equal quantiles, Σᵢ τ̂ᵢ
        return scale * 0.5 * (mean - target.mean(-1)) ** 2 + SHAPE_LOSS_WEIGHT * shape

    return _critic(obs_size, quantiles, error, head=monotone_quantiles, **network)


CRITICS: dict[str, Callable[..., Critic]] = {
    "scalar": scalar_critic,
    "quantile": quantile_critic,
    "sorted": sorted_critic,
    "ordered": ordered_critic,
}
"""`critic(obs_size, hidden=, target=, **options)`."""


def td_error(weights: ArrayLike | None) -> Residual:
    """Return the scalar TD error, of the means (below Eq. GAE); it has no metric."""
    return lambda reward, discount, quantiles, next_quantiles: td_residual(
        reward, discount, quantiles.mean(-1), next_quantiles.mean(-1)
    )


def distributional_td_error(weights: ArrayLike | None) -> Residual:
    """Return the TD error under the metric of these weights (Def. distributional_TD_error)."""
    return partial(distributional_td_residual, weights=weights)


RESIDUALS: dict[str, Callable[[ArrayLike | None], Residual]] = {
    "td": td_error,
    "distributional": distributional_td_error,
}
