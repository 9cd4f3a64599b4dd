"""Risk preferences as spectral weights over the quantiles of a value distribution.

A preference is a distortion D: [0, 1] → [0, 1], increasing, D(0) = 0, D(1) = 1; its weights are the increments of D over
K equal cells, times K. Their mean is D(1) = 1, so that the directional metric stays translation and scale equivariant.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from dgae_jax.maths.transport import spectral_weights


class Metric(NamedTuple):
    """A family of preferences: its parameters, what they may be, and its weights."""

    parameters: tuple[str, ...]
    allowed: Callable[..., bool]
    limits: str
    weights: Callable[..., Array]
    """`weights(K, *parameters) -> [K]`, non-negative and of mean 1."""


def _cells(distortion: Callable[[Array], Array]) -> Callable[[int], Array]:
    return lambda k: k * jnp.diff(distortion(jnp.linspace(0.0, 1.0, k + 1)))


def cvar(k: int, alpha: float) -> Float[Array, " K"]:
    """Conditional value at risk: the mean of the worst share α (Rockafellar & Uryasev 2000)."""
    return _cells(lambda q: jnp.minimum(q / alpha, 1))(k)


def wang(k: int, beta: float) -> Float[Array, " K"]:
    """D(q) = Φ(Φ⁻¹(q) + β): averse to risk for β > 0 (Wang 2000)."""
    return _cells(lambda q: norm.cdf(norm.ppf(q) + beta))(k)


def power(k: int, c: float) -> Float[Array, " K"]:
    """D(q) = 1 − (1 − q)ᶜ: for a whole c the expected minimum of c draws; seeking risk for c < 1 (proportional hazard)."""
    return _cells(lambda q: 1 - (1 - q) ** c)(k)


def mean_cvar(k: int, alpha: float, weight: float) -> Float[Array, " K"]:
    """`weight` parts of CVaR and the rest the mean."""
    return weight * cvar(k, alpha) + (1 - weight) * jnp.ones(k)


METRICS = {
    "mean": Metric((), lambda: True, "", lambda k: jnp.ones(k)),
    "cvar": Metric(("α",), lambda a: 1e-6 <= a <= 1, "1e-6 ≤ α ≤ 1", cvar),
    "wang": Metric(("β",), lambda b: abs(b) <= 5, "−5 ≤ β ≤ 5", wang),
    "power": Metric(("c",), lambda c: 1e-3 <= c <= 1e3, "1e-3 ≤ c ≤ 1e3", power),
    "mean-cvar": Metric(("α", "weight"), lambda a, w: 1e-6 <= a <= 1 and 0 <= w <= 1, "1e-6 ≤ α ≤ 1 and 0 ≤ weight ≤ 1", mean_cvar),
}
"""User preferences join here: `METRICS["mine"] = Metric((), lambda: True, "", lambda k: weights)`."""


def forms() -> str:
    """How the known metrics are written."""
    return ", ".join(":".join((name, *metric.parameters)) for name, metric in METRICS.items())


def weights_of(metric: str, k: int) -> Float[Array, " K"] | None:
    """The weights that `NAME:PARAMETER:…` asks for over K quantiles; None for the mean, the paper's metric.

    Raises ValueError, saying what is allowed, for anything else, and for weights that are negative or not of mean 1.
    """
    name, *rest = metric.split(":")
    if metric == "mean":
        return None
    if name not in METRICS or len(rest) != len(METRICS[name].parameters):
        raise ValueError(f"one of {forms()}")
    family = METRICS[name]
    try:
        parameters = [float(x) for x in rest]
    except ValueError:
        raise ValueError(f"{':'.join((name, *family.parameters))} with numbers") from None
    if not family.allowed(*parameters):
        raise ValueError(f"{':'.join((name, *family.parameters))} with {family.limits}")
    return spectral_weights(family.weights(k, *parameters))
