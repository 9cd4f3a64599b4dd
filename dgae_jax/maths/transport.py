"""Distributions as quantiles at midpoints, and metrics and losses between them.

A value distribution is an array whose last axis holds F⁻¹(τ̂ᵢ), i = 0 … K−1; every function takes
any leading axes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dgae_jax.maths.risk import check_spectral

Quantiles = Float[Array, "*#batch K"]

UNROLL = 16
"""Targets per loop iteration on a CPU: more take longer to compile and are no faster."""


def quantile_midpoints(k: int) -> Float[Array, " K"]:
    """Return the midpoints τ̂ᵢ = (2i + 1) / 2K, K ≥ 1 (Dabney et al. 2018, Lemma 2)."""
    if k < 1:
        raise ValueError(f"the number of quantiles is {k}; it must be at least 1")
    return (2 * jnp.arange(k) + 1) / (2 * k)


GAP_BIAS = 5.0
"""Subtracted from the network's outputs for gaps, so that quantiles begin 0.0067 apart."""


def centered_cumsum(k: int) -> Float[Array, "steps K"]:
    """Return the matrix [K − 1, K] that maps gaps to the K quantiles less their mean."""
    step, at = jnp.arange(1, k)[:, None], jnp.arange(k)
    return (at >= step) - (k - step) / k


def monotone_quantiles(outputs: Quantiles) -> Quantiles:
    """Return K quantiles that do not cross, up to rounding.

    Args:
        outputs: the mean, then for each gap g the number x with g = log(1 + exp(x − `GAP_BIAS`)).
    """
    mean, gaps = outputs[..., :1], jax.nn.softplus(outputs[..., 1:] - GAP_BIAS)
    return mean + gaps @ centered_cumsum(outputs.shape[-1])


def directional_metric(
    u: Quantiles, v: Quantiles, weights: ArrayLike | None = None
) -> Float[Array, "*batch"]:
    """Compute d(U, V) = ∫ w(q) (F_U⁻¹(q) − F_V⁻¹(q)) dq (Def. Wasserstein_like_metric).

    With the paper's w ≡ 1 it is the difference of the means. Other weights make it spectral (the
    paper's footnote on uncertainty); quantiles are then sorted first, because a network's may
    cross.

    Args:
        u: quantiles [..., K] of U.
        v: quantiles [..., K] of V.
        weights: w [K] ≥ 0 of mean 1, on which the theorem's telescoping rests; None for w ≡ 1.
            Traced ones pass unchecked.

    Returns:
        d [...]; positive where U is better.

    Raises:
        ValueError: weights are negative or not of mean 1.
    """
    if weights is None:
        return (u - v).mean(-1)
    if not isinstance(weights, jax.core.Tracer):
        weights = check_spectral(weights)
    return (jnp.asarray(weights, float) * (jnp.sort(u) - jnp.sort(v))).mean(-1)


def wasserstein(u: Quantiles, v: Quantiles, p: float = 1) -> Float[Array, "*batch"]:
    """Compute the Wasserstein distance (∫ |F_U⁻¹(q) − F_V⁻¹(q)|ᵖ dq)^(1/p), p ≥ 1 (Prop. OT_cost).

    Args:
        u: quantiles [..., K] of U.
        v: quantiles [..., K] of V.
        p: order.
    """
    if not p >= 1:
        raise ValueError(f"the order p of a Wasserstein distance is {p}; it must be at least 1")
    return (jnp.abs(jnp.sort(u) - jnp.sort(v)) ** p).mean(-1) ** (1 / p)


def quantile_huber_loss(
    quantiles: Quantiles,
    target: Float[Array, "*#batch J"],
    *,
    kappa: ArrayLike = 1.0,
) -> Float[Array, "*batch"]:
    """Compute Σᵢ meanⱼ |τ̂ᵢ − 1{u<0}| L_κ(u), u = targetⱼ − quantileᵢ (Eq. quantile_huber_loss).

    As κ → 0 its minimizer over quantileᵢ tends to the empirical τ̂ᵢ-quantile of the targets.
    Differentiable once, in reverse mode, by quantiles and targets.

    Args:
        quantiles: predictions [..., K].
        target: samples [..., J] of the return.
        kappa: threshold κ > 0, in units of the return.
    """
    batch = jnp.broadcast_shapes(quantiles.shape[:-1], target.shape[:-1])
    quantiles, target = (jnp.broadcast_to(x, (*batch, x.shape[-1])) for x in (quantiles, target))
    return _quantile_huber(quantiles, target, jnp.asarray(kappa, quantiles.dtype))


@jax.custom_vjp
def _quantile_huber(quantiles: Array, target: Array, kappa: Array) -> Array:
    return _loss_and_slopes(quantiles, target, kappa)[0]


def _loss_and_slopes(quantiles: Array, target: Array, kappa: Array):
    """Compute the loss, and its derivatives by quantiles and targets.

    L_κ(u) is slope · (u − ½ slope), and its slope is u clipped to ±κ. A CPU takes one target after
    the other: storing the K × J errors of a sample costs several times more than computing them. An
    accelerator computes all at once: there each loop iteration costs a kernel launch.
    """
    tau, count = quantile_midpoints(quantiles.shape[-1]), target.shape[-1]

    def weighted(error: Array, tau: Array) -> tuple[Array, Array]:
        weight = jnp.where(error < 0, 1 - tau, tau)
        slope = jnp.clip(error, jnp.negative(kappa), kappa)
        return weight * (slope * (error - 0.5 * slope)), weight * slope

    def on_cpu(quantiles: Array, target: Array):
        def add(sums: tuple[Array, Array], target: Array):
            loss, slope = weighted(target[..., None] - quantiles, tau)
            return (sums[0] + loss, sums[1] - slope), slope.sum(-1)

        zeros, targets = jnp.zeros_like(quantiles), jnp.moveaxis(target, -1, 0)
        sums, by_target = jax.lax.scan(add, (zeros, zeros), targets, unroll=UNROLL)
        return sums[0].sum(-1), sums[1], jnp.moveaxis(by_target, 0, -1)

    def on_accelerator(quantiles: Array, target: Array):
        loss, slope = weighted(target[..., None, :] - quantiles[..., None], tau[:, None])
        return loss.sum((-2, -1)), -slope.sum(-1), slope.sum(-2)

    loss, by_quantiles, by_target = jax.lax.platform_dependent(
        quantiles, target, cpu=on_cpu, default=on_accelerator
    )
    return loss / count, (by_quantiles / count, by_target / count)


def _backward(slopes: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array, Array]:
    by_quantiles, by_target = (slope * cotangent[..., None] for slope in slopes)
    return by_quantiles, by_target, jnp.zeros((), by_quantiles.dtype)


_quantile_huber.defvjp(_loss_and_slopes, _backward)
