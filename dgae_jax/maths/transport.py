"""Distributions as inverse CDFs sampled at quantile midpoints, and what can be measured between them.

A value distribution is an array whose last axis holds F⁻¹(τ̂ᵢ), i = 0 … K−1; every function takes any leading axes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dgae_jax.maths.risk import check_spectral

_UNROLL = 16
"""Targets of the quantile-Huber loss per turn of its loop: more of them take longer to compile and are no faster."""


def quantile_midpoints(k: int) -> Float[Array, " K"]:
    """τ̂ᵢ = (2i + 1) / 2K, the points at which K quantiles represent a distribution (Dabney et al. 2018, Lemma 2)."""
    if k < 1:
        raise ValueError(f"the number of quantiles is {k}; it must be at least 1")
    return (2 * jnp.arange(k) + 1) / (2 * k)


GAP_BIAS = 5.0
"""Subtracted from what a network says of a step between quantiles, so that they begin 0.0067 apart."""


def centered_cumsum(k: int) -> Float[Array, "steps K"]:
    """The matrix [K − 1, K] that makes K quantiles, less their mean, of the steps from each to the next."""
    step, at = jnp.arange(1, k)[:, None], jnp.arange(k)
    return (at >= step) - (k - step) / k


def monotone_quantiles(outputs: Float[Array, "*batch K"]) -> Float[Array, "*batch K"]:
    """K quantiles that do not cross, but for rounding: the first output is their mean, log(1 + exp(outputᵢ − `GAP_BIAS`)) the step from
    quantile i − 1 to quantile i.
    """
    return outputs[..., :1] + jax.nn.softplus(outputs[..., 1:] - GAP_BIAS) @ centered_cumsum(
        outputs.shape[-1]
    )


def spectral_weights(weights: ArrayLike) -> Float[Array, " K"]:
    """Weights that keep the directional metric translation and scale equivariant, on which the theorem's telescoping rests.

    Raises as `check_spectral`; traced weights pass unchecked, because their values are not known yet.
    """
    return jnp.asarray(
        weights if isinstance(weights, jax.core.Tracer) else check_spectral(weights), float
    )


def directional_metric(
    u: Float[Array, "*#batch K"], v: Float[Array, "*#batch K"], weights: ArrayLike | None = None
) -> Float[Array, "*batch"]:
    """d(U, V) = ∫ w(q) (F_U⁻¹(q) − F_V⁻¹(q)) dq, positive when U is superior (Def. Wasserstein_like_metric).

    The paper's metric has L(x) = x, that is w ≡ 1: the difference of the means. Other `weights` [K], w ≥ 0 with
    mean 1, make it spectral (the paper's footnote on uncertainty); quantiles are then sorted first, because a network's
    may cross. Raises ValueError for weights that are negative or do not integrate to 1.
    """
    if weights is None:
        return (u - v).mean(-1)
    return (spectral_weights(weights) * (jnp.sort(u) - jnp.sort(v))).mean(-1)


def wasserstein(
    u: Float[Array, "*#batch K"], v: Float[Array, "*#batch K"], p: float = 1
) -> Float[Array, "*batch"]:
    """d_p = (∫ |F_U⁻¹(q) − F_V⁻¹(q)|ᵖ dq)^(1/p), p ≥ 1 (Prop. OT_cost)."""
    if not p >= 1:
        raise ValueError(f"the order p of a Wasserstein distance is {p}; it must be at least 1")
    return (jnp.abs(jnp.sort(u) - jnp.sort(v)) ** p).mean(-1) ** (1 / p)


def huber(
    u: Float[Array, "*shape"], kappa: ArrayLike
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """L_κ(u) = ½u² where |u| ≤ κ, κ(|u| − ½κ) beyond (below Eq. quantile_huber_loss), and its derivative, the clipped u."""
    slope = jnp.clip(u, jnp.negative(kappa), kappa)
    return slope * (u - 0.5 * slope), slope


def quantile_huber_loss(
    quantiles: Float[Array, "*#batch K"],
    target: Float[Array, "*#batch J"],
    *,
    kappa: ArrayLike = 1.0,
) -> Float[Array, "*batch"]:
    """Σᵢ meanⱼ |τ̂ᵢ − 1{u<0}| L_κ(u), u = targetⱼ − quantileᵢ (Eq. quantile_huber_loss), per sample.

    As κ → 0 its minimiser over quantileᵢ tends to the empirical τ̂ᵢ-quantile of the targets. Differentiable once, in reverse; κ is held
    constant.
    """
    batch = jnp.broadcast_shapes(quantiles.shape[:-1], target.shape[:-1])
    quantiles, target = (jnp.broadcast_to(x, (*batch, x.shape[-1])) for x in (quantiles, target))
    return _quantile_huber(quantiles, target, jnp.asarray(kappa, quantiles.dtype))


@jax.custom_vjp
def _quantile_huber(quantiles: Array, target: Array, kappa: Array) -> Array:
    return _loss_and_slopes(quantiles, target, kappa)[0]


def _loss_and_slopes(
    quantiles: Array, target: Array, kappa: Array
) -> tuple[Array, tuple[Array, Array]]:
    """The loss and its derivatives by quantiles and targets.

    On a CPU one target after the other: laying out the K × J residuals of a sample would cost several times more than computing
    them. An accelerator computes them all at once, because there every turn of a loop costs a launch.
    """
    tau = quantile_midpoints(quantiles.shape[-1])
    count = target.shape[-1]

    def weighed(u: Array, tau: Array) -> list[Array]:
        weight = jnp.where(u < 0, 1 - tau, tau)
        return [weight * x for x in huber(u, kappa)]

    def in_turn(quantiles: Array, target: Array) -> tuple[Array, Array, Array]:
        def add(sums: tuple[Array, Array], target: Array):
            distance, pull = weighed(target[..., None] - quantiles, tau)
            return (sums[0] + distance, sums[1] - pull), pull.sum(-1)

        nothing = jnp.zeros_like(quantiles)
        (loss, slope), pulls = jax.lax.scan(
            add, (nothing, nothing), jnp.moveaxis(target, -1, 0), unroll=_UNROLL
        )
        return loss.sum(-1), slope, jnp.moveaxis(pulls, 0, -1)

    def at_once(quantiles: Array, target: Array) -> tuple[Array, Array, Array]:
        distance, pull = weighed(target[..., None, :] - quantiles[..., None], tau[:, None])
        return distance.sum((-2, -1)), -pull.sum(-1), pull.sum(-2)

    loss, slope, pulls = jax.lax.platform_dependent(quantiles, target, cpu=in_turn, default=at_once)
    return loss / count, (slope / count, pulls / count)


def _backward(slopes: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array, Array]:
    by_quantiles, by_target = (slope * cotangent[..., None] for slope in slopes)
    return by_quantiles, by_target, jnp.zeros((), by_quantiles.dtype)


_quantile_huber.defvjp(_loss_and_slopes, _backward)
