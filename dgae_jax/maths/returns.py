"""From rewards and value predictions to advantages and critic targets, over the leading time axis.

Two masks with two roles: `terminated` ends the bootstrap, `done = terminated | truncated` cuts the trace. They appear
as discountₜ = γ(1 − terminatedₜ) and traceₜ = λ(1 − doneₜ), so that γλ(1 − doneₜ) = discountₜ·traceₜ. `next_…` are
predictions at the true successor, so neither time limits nor the end of the rollout need a special case.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Key, Shaped

from dgae_jax.maths.transport import directional_metric

Mask = Bool[Array, "T *batch"] | Float[Array, "T *batch"]


class Decay(NamedTuple):
    """The factors of the bootstrap, γ(1 − terminated), and of the trace, λ(1 − done)."""

    discount: Float[Array, "T *batch"]
    trace: Float[Array, "T *batch"]


def decay(terminated: Mask, truncated: Mask, *, gamma: ArrayLike, lam: ArrayLike) -> Decay:
    """The two masks as the two factors every estimator below is written in."""
    done = jnp.logical_or(terminated, truncated)
    return Decay(
        jnp.multiply(gamma, 1.0 - jnp.asarray(terminated, float)),
        jnp.multiply(lam, 1.0 - jnp.asarray(done, float)),
    )


def lambda_sum(
    delta: Float[Array, "T *batch"], factor: Float[Array, "T *batch"]
) -> Float[Array, "T *batch"]:
    """Aₜ = δₜ + factorₜ Aₜ₊₁, A_T = 0, so Aₜ = Σₖ (γλ)ᵏ δₜ₊ₖ within an episode (Theorem, Eq. gae_final)."""

    def back(advantage, step):
        residual, factor = step
        advantage = residual + factor * advantage
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, factor), reverse=True)[1]


def td_residual(
    reward: Float[Array, "*batch"],
    discount: Float[Array, "*batch"],
    value: Float[Array, "*batch"],
    next_value: Float[Array, "*batch"],
) -> Float[Array, "*batch"]:
    """δ = r + γ V(s′) − V(s) (below Eq. GAE)."""
    return reward + discount * next_value - value


def distributional_td_residual(
    reward: Float[Array, "*batch"],
    discount: Float[Array, "*batch"],
    quantiles: Float[Array, "*batch K"],
    next_quantiles: Float[Array, "*batch K"],
    weights: ArrayLike | None = None,
) -> Float[Array, "*batch"]:
    """δ^G = r + d(γ G(s′), G(s)) (Def. distributional_TD_error)."""
    return reward + directional_metric(discount[..., None] * next_quantiles, quantiles, weights)


def gae(
    reward: Float[Array, "T *batch"],
    value: Float[Array, "T *batch"],
    next_value: Float[Array, "T *batch"],
    terminated: Mask,
    truncated: Mask,
    *,
    gamma: ArrayLike,
    lam: ArrayLike,
) -> Float[Array, "T *batch"]:
    """Â = Σₖ (γλ)ᵏ δₜ₊ₖ with the scalar TD error (Eq. GAE; Schulman et al. 2016)."""
    discount, trace = decay(terminated, truncated, gamma=gamma, lam=lam)
    return lambda_sum(td_residual(reward, discount, value, next_value), discount * trace)


def dgae(
    reward: Float[Array, "T *batch"],
    quantiles: Float[Array, "T *batch K"],
    next_quantiles: Float[Array, "T *batch K"],
    terminated: Mask,
    truncated: Mask,
    *,
    gamma: ArrayLike,
    lam: ArrayLike,
    weights: ArrayLike | None = None,
) -> Float[Array, "T *batch"]:
    """Â_DGAE = Σₖ (γλ)ᵏ δ^Ĝₜ₊ₖ with the distributional TD error (Theorem, Eq. gae_final).

    With the paper's L(x) = x (`weights=None`) this equals `gae` on the means of the quantiles.
    """
    discount, trace = decay(terminated, truncated, gamma=gamma, lam=lam)
    return lambda_sum(
        distributional_td_residual(reward, discount, quantiles, next_quantiles, weights),
        discount * trace,
    )


def n_step_advantage(
    reward: Float[Array, "T *batch"],
    quantiles: Float[Array, "T *batch K"],
    next_quantiles: Float[Array, "T *batch K"],
    terminated: Mask,
    truncated: Mask,
    *,
    gamma: ArrayLike,
    n: int,
    weights: ArrayLike | None = None,
) -> Float[Array, "T *batch"]:
    """Â⁽ⁿ⁾ = d(r(τ) + γⁿ Ĝ(sₜ₊ₙ), Ĝ(sₜ)), r(τ) = Σₖ₍ₖ<ₙ₎ γᵏ rₜ₊ₖ (Def. k_step_estimator).

    A trajectory that ends earlier, by episode or rollout, uses the steps it has.
    """
    if n < 1:
        raise ValueError(f"the number of steps n is {n}; it must be at least 1")
    discount, go_on = (x[..., None] for x in decay(terminated, truncated, gamma=gamma, lam=1.0))
    successor = next_quantiles
    for _ in range(n - 1):
        n_step = reward[..., None] + discount * successor
        later = jnp.concatenate([n_step[1:], next_quantiles[-1:]])
        successor = jnp.where(go_on > 0, later, next_quantiles)
    return directional_metric(reward[..., None] + discount * successor, quantiles, weights)


# ---- critic targets, from predictions of the critic that acted ----


def bellman_target(
    reward: Float[Array, "*batch"],
    discount: Float[Array, "*batch"],
    next_quantiles: Float[Array, "*batch K"],
) -> Float[Array, "*batch K"]:
    """𝒯G(s) = r + γ G(s′), atom by atom (Eq. G_dis_bellman; Lemma lemma1 with η = γ ≥ 0)."""
    return reward[..., None] + discount[..., None] * next_quantiles


def lambda_return(
    reward: Float[Array, "T *batch"],
    discount: Float[Array, "T *batch"],
    trace: Float[Array, "T *batch"],
    quantiles: Float[Array, "T *batch K"],
    next_quantiles: Float[Array, "T *batch K"],
) -> Float[Array, "T *batch"]:
    """The λ-return G^λ = V + Â_GAE, with V the mean of the quantiles (Schulman et al. 2016)."""
    value = quantiles.mean(-1)
    delta = td_residual(reward, discount, value, next_quantiles.mean(-1))
    return value + lambda_sum(delta, discount * trace)


def lambda_shift_target(
    reward: Float[Array, "T *batch"],
    discount: Float[Array, "T *batch"],
    trace: Float[Array, "T *batch"],
    quantiles: Float[Array, "T *batch K"],
    next_quantiles: Float[Array, "T *batch K"],
) -> Float[Array, "T *batch K"]:
    """The one-step target's shape, moved to the λ-return's mean: 𝒯G − E[𝒯G] + G^λ."""
    one_step = bellman_target(reward, discount, next_quantiles)
    mean = lambda_return(reward, discount, trace, quantiles, next_quantiles)
    return one_step - one_step.mean(-1, keepdims=True) + mean[..., None]


def sr_lambda_target(
    key: Key[Array, ""] | Shaped[Array, "2"],
    reward: Float[Array, "T *batch"],
    discount: Float[Array, "T *batch"],
    trace: Float[Array, "T *batch"],
    next_quantiles: Float[Array, "T *batch K"],
) -> Float[Array, "T *batch K"]:
    """SR(λ), sample replacement: yₜ = r + γ·(yₜ₊₁ with probability traceₜ, else Ĝ(sₜ₊₁)), atom by atom, backwards.

    In expectation over the coin flips the atoms are drawn from the geometric mixture of the n-step return
    distributions, and their mean is the λ-return (Nam et al. 2021, GMAC).
    """
    follow = jax.random.uniform(key, next_quantiles.shape) < trace[..., None]

    def back(later, step):
        reward, discount, quantiles, follow = step
        target = bellman_target(reward, discount, jnp.where(follow, later, quantiles))
        return target, target

    return jax.lax.scan(
        back, next_quantiles[-1], (reward, discount, next_quantiles, follow), reverse=True
    )[1]
