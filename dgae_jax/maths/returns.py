"""Advantages and critic targets from rewards and value predictions, over the leading time axis.

Two masks have two roles: `terminated` ends the bootstrap, `done = terminated | truncated` cuts the
trace. The functions share these arguments, where T are time steps and K quantiles:

    reward: rewards [T, ...].
    quantiles: predictions [T, ..., K] before each step.
    next_quantiles: predictions [T, ..., K] for the true successor of each step, so that neither
        time limits nor the end of a rollout need a special case.
    discount: γ(1 − terminated) [T, ...].
    trace: λ(1 − done) [T, ...], so that γλ(1 − done) = discount · trace.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Key, Shaped

from dgae_jax.maths.transport import directional_metric

Steps = Float[Array, "*steps"]
Quantiles = Float[Array, "*steps K"]
Mask = Bool[Array, "*steps"] | Steps


def decay(
    terminated: Mask, truncated: Mask, *, gamma: ArrayLike, lam: ArrayLike
) -> tuple[Steps, Steps]:
    """Return `discount` and `trace` of the estimators below, for γ and λ from 0 to 1."""
    done = jnp.logical_or(terminated, truncated)
    discount = jnp.multiply(gamma, 1.0 - jnp.asarray(terminated, float))
    return discount, jnp.multiply(lam, 1.0 - jnp.asarray(done, float))


def lambda_sum(delta: Steps, factor: Steps) -> Steps:
    """Compute Aₜ = δₜ + factorₜ Aₜ₊₁ with A_T = 0 (Theorem, Eq. gae_final).

    With factor = γλ(1 − done) it is Σₖ (γλ)ᵏ δₜ₊ₖ within an episode.
    """

    def backward(advantage, step):
        delta, factor = step
        advantage = delta + factor * advantage
        return advantage, advantage

    return jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, factor), reverse=True)[1]


def td_residual(reward: Steps, discount: Steps, value: Steps, next_value: Steps) -> Steps:
    """Compute the TD error δ = r + γ V(s′) − V(s) (below Eq. GAE)."""
    return reward + discount * next_value - value


def distributional_td_residual(
    reward: Steps,
    discount: Steps,
    quantiles: Quantiles,
    next_quantiles: Quantiles,
    weights: ArrayLike | None = None,
) -> Steps:
    """Compute the distributional TD error r + d(γ G(s′), G(s)) (Def. distributional_TD_error).

    `weights` are those of `transport.directional_metric`.
    """
    return reward + directional_metric(discount[..., None] * next_quantiles, quantiles, weights)


def gae(
    reward: Steps,
    value: Steps,
    next_value: Steps,
    terminated: Mask,
    truncated: Mask,
    *,
    gamma: ArrayLike,
    lam: ArrayLike,
) -> Steps:
    """Compute Â = Σₖ (γλ)ᵏ δₜ₊ₖ with the scalar TD error (Eq. GAE; Schulman et al. 2016).

    Args:
        reward: rewards [T, ...].
        value: V(s) [T, ...].
        next_value: V(s′) [T, ...] of the true successor.
        terminated: the task ended: what follows is worth 0.
        truncated: the episode was cut: what follows keeps its value.
        gamma: discount factor γ.
        lam: λ of the trace.

    Returns:
        Advantages [T, ...].
    """
    discount, trace = decay(terminated, truncated, gamma=gamma, lam=lam)
    return lambda_sum(td_residual(reward, discount, value, next_value), discount * trace)


def dgae(
    reward: Steps,
    quantiles: Quantiles,
    next_quantiles: Quantiles,
    terminated: Mask,
    truncated: Mask,
    *,
    gamma: ArrayLike,
    lam: ArrayLike,
    weights: ArrayLike | None = None,
) -> Steps:
    """Compute Â_DGAE = Σₖ (γλ)ᵏ δ^Ĝₜ₊ₖ with the distributional TD error (Theorem, Eq. gae_final).

    With the paper's L(x) = x (`weights=None`) this equals `gae` on the means of the quantiles.

    Args:
        reward: rewards [T, ...].
        quantiles: Ĝ(s) [T, ..., K].
        next_quantiles: Ĝ(s′) [T, ..., K] of the true successor.
        terminated: the task ended: what follows is worth 0.
        truncated: the episode was cut: what follows keeps its value.
        gamma: discount factor γ.
        lam: λ of the trace.
        weights: see `transport.directional_metric`.

    Returns:
        Advantages [T, ...].
    """
    discount, trace = decay(terminated, truncated, gamma=gamma, lam=lam)
    return lambda_sum(
        distributional_td_residual(reward, discount, quantiles, next_quantiles, weights),
        discount * trace,
    )


def n_step_advantage(
    reward: Steps,
    quantiles: Quantiles,
    next_quantiles: Quantiles,
    terminated: Mask,
    truncated: Mask,
    *,
    gamma: ArrayLike,
    n: int,
    weights: ArrayLike | None = None,
) -> Steps:
    """Compute Â⁽ⁿ⁾ = d(Σₖ₍ₖ<ₙ₎ γᵏ rₜ₊ₖ + γⁿ Ĝ(sₜ₊ₙ), Ĝ(sₜ)) (Def. k_step_estimator).

    A trajectory that ends earlier, by episode or rollout, uses the steps that it has.
    Arguments are those of `dgae`, and the number of steps n ≥ 1.
    """
    if n < 1:
        raise ValueError(f"the number of steps n is {n}; it must be at least 1")
    factors = decay(terminated, truncated, gamma=gamma, lam=1.0)
    discount, continues = (x[..., None] for x in factors)
    successor = next_quantiles
    for _ in range(n - 1):
        n_step = reward[..., None] + discount * successor
        later = jnp.concatenate([n_step[1:], next_quantiles[-1:]])
        successor = jnp.where(continues > 0, later, next_quantiles)
    return directional_metric(reward[..., None] + discount * successor, quantiles, weights)


# ---- critic targets, from predictions of the critic at rollout time ----


def bellman_target(reward: Steps, discount: Steps, next_quantiles: Quantiles) -> Quantiles:
    """Compute 𝒯G(s) = r + γ G(s′), atom by atom (Eq. G_dis_bellman; Lemma lemma1 with η = γ)."""
    return reward[..., None] + discount[..., None] * next_quantiles


def lambda_return(
    reward: Steps, discount: Steps, trace: Steps, quantiles: Quantiles, next_quantiles: Quantiles
) -> Steps:
    """Compute the λ-return G^λ = V + Â_GAE, V the mean of the quantiles (Schulman et al. 2016)."""
    value = quantiles.mean(-1)
    delta = td_residual(reward, discount, value, next_quantiles.mean(-1))
    return value + lambda_sum(delta, discount * trace)


def lambda_shift_target(
    reward: Steps, discount: Steps, trace: Steps, quantiles: Quantiles, next_quantiles: Quantiles
) -> Quantiles:
    """Compute 𝒯G − E[𝒯G] + G^λ, the one-step target shifted to the mean of the λ-return."""
    one_step = bellman_target(reward, discount, next_quantiles)
    mean = lambda_return(reward, discount, trace, quantiles, next_quantiles)
    return one_step - one_step.mean(-1, keepdims=True) + mean[..., None]


def sr_lambda_target(
    key: Key[Array, ""] | Shaped[Array, "2"],
    reward: Steps,
    discount: Steps,
    trace: Steps,
    next_quantiles: Quantiles,
) -> Quantiles:
    """Sample SR(λ): yₜ = r + γ·(yₜ₊₁ with probability traceₜ, else Ĝ(sₜ₊₁)), atom by atom.

    In expectation over the coin flips the atoms come from the geometric mixture of the n-step
    return distributions, and their mean is the λ-return (sample replacement; Nam et al. 2021).
    """
    continues = jax.random.uniform(key, next_quantiles.shape) < trace[..., None]

    def backward(later, step):
        reward, discount, quantiles, continues = step
        target = bellman_target(reward, discount, jnp.where(continues, later, quantiles))
        return target, target

    steps = reward, discount, next_quantiles, continues
    return jax.lax.scan(backward, next_quantiles[-1], steps, reverse=True)[1]
