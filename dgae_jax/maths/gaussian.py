"""Normal distributions of actions with diagonal covariance; the last axis is the action."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key


class Gaussian(NamedTuple):
    """N(mean, diag(exp(2 log_std)))."""

    mean: Float[Array, "*batch A"]
    log_std: Float[Array, "*batch A"]


def sample(key: Key[Array, ""], distribution: Gaussian) -> Float[Array, "*batch A"]:
    """Draw mean + σ·ε with ε ~ N(0, I)."""
    mean, log_std = distribution
    return mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, mean.dtype)


def log_prob(distribution: Gaussian, action: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
    """Compute log π(a) = −Σ [½((a − mean)/σ)² + log σ + ½ log 2π]."""
    mean, log_std = distribution
    return -(
        0.5 * ((action - mean) * jnp.exp(-log_std)) ** 2 + log_std + 0.5 * math.log(2 * math.pi)
    ).sum(-1)


def entropy(distribution: Gaussian) -> Float[Array, "*batch"]:
    """Compute the entropy Σ [log σ + ½ log 2πe] [nats]."""
    return (distribution.log_std + 0.5 * math.log(2 * math.pi * math.e)).sum(-1)


def kl(p: Gaussian, q: Gaussian) -> Float[Array, "*batch"]:
    """Compute KL(p ‖ q) = Σ [log σ_q/σ_p + (σ_p² + (μ_p − μ_q)²) / 2σ_q² − ½] [nats]."""
    log_ratio = q.log_std - p.log_std
    distance = (p.mean - q.mean) * jnp.exp(-q.log_std)
    return (log_ratio + 0.5 * (jnp.exp(-2 * log_ratio) + distance**2 - 1)).sum(-1)
