"""Risk measures as spectral weights over the quantiles of a value distribution.

A risk measure is a distortion D: [0, 1] → [0, 1], increasing, with D(0) = 0 and D(1) = 1. Its
weights are the increments of D over K equal cells, times K. Their mean is D(1) = 1, so that the
directional metric stays translation and scale equivariant.
"""

from collections.abc import Callable
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike


def check_spectral(weights: ArrayLike) -> np.ndarray:
    """Return the weights [K] of a spectral risk measure.

    Raises:
        ValueError: unless w ≥ 0 and ∫ w(q) dq = 1, the mean over the midpoints.
    """
    w = np.asarray(weights, np.float64)
    if w.ndim != 1 or (w < 0).any() or not abs(w.mean() - 1) < 1e-5:
        found = f"shape {w.shape}, minimum {w.min():g}, mean {w.mean():g}"
        raise ValueError(f"spectral weights: must be a vector ≥ 0 and of mean 1, not {found}")
    return w


class Metric(NamedTuple):
    """A family of risk measures: its parameters, what they may be, and its weights."""

    parameters: tuple[str, ...]
    allowed: Callable[..., bool]
    limits: str
    weights: Callable[..., ArrayLike]
    """`weights(K, *parameters) -> [K]`, non-negative and of mean 1."""


def _cells(distortion: Callable[[float], float], k: int) -> Float[np.ndarray, " K"]:
    inner = [distortion(i / k) for i in range(1, k)]
    return k * np.diff([0.0, *inner, 1.0])


def cvar(k: int, alpha: float) -> Float[np.ndarray, " K"]:
    """Compute the weights of CVaR, the mean of the worst share α (Rockafellar & Uryasev 2000)."""
    return _cells(lambda q: min(q / alpha, 1.0), k)


def wang(k: int, beta: float) -> Float[np.ndarray, " K"]:
    """Compute the weights of D(q) = Φ(Φ⁻¹(q) + β), risk-averse for β > 0 (Wang 2000)."""
    normal = NormalDist()
    return _cells(lambda q: normal.cdf(normal.inv_cdf(q) + beta), k)


def power(k: int, c: float) -> Float[np.ndarray, " K"]:
    """Compute the weights of D(q) = 1 − (1 − q)ᶜ, the proportional hazard.

    For a whole c it is the expected minimum of c draws; for c < 1 it seeks risk.
    """
    return _cells(lambda q: 1 - (1 - q) ** c, k)


def mean_cvar(k: int, alpha: float, weight: float) -> Float[np.ndarray, " K"]:
    """Compute the weights of `weight` parts of CVaR and 1 − `weight` parts of the mean."""
    return weight * cvar(k, alpha) + (1 - weight)


METRICS = {
    "mean": Metric((), lambda: True, "", np.ones),
    "cvar": Metric(("α",), lambda a: 1e-6 <= a <= 1, "1e-6 ≤ α ≤ 1", cvar),
    "wang": Metric(("β",), lambda b: abs(b) <= 5, "−5 ≤ β ≤ 5", wang),
    "power": Metric(("c",), lambda c: 1e-3 <= c <= 1e3, "1e-3 ≤ c ≤ 1e3", power),
    "mean-cvar": Metric(
        ("α", "weight"),
        lambda a, w: 1e-6 <= a <= 1 and 0 <= w <= 1,
        "1e-6 ≤ α ≤ 1 and 0 ≤ weight ≤ 1",
        mean_cvar,
    ),
}
"""Add your own: `METRICS["mine"] = Metric((), lambda: True, "", lambda k: weights)`."""


def weights_of(metric: str, k: int) -> Float[np.ndarray, " K"] | None:
    """Return the weights [K] of a risk measure; None for `mean`, the paper's metric.

    Args:
        metric: `NAME:PARAMETER:…`, such as `cvar:0.25`; the names are those of `METRICS`.
        k: number of quantiles K.

    Raises:
        ValueError: the metric does not exist, or its weights are negative or not of mean 1.
    """
    family, parameters = parse(metric)
    return None if metric == "mean" else check_spectral(family.weights(k, *parameters))


def parse(metric: str) -> tuple[Metric, list[float]]:
    """Return the family and the parameters of a metric; raise ValueError saying what is allowed."""
    forms = {name: ":".join((name, *family.parameters)) for name, family in METRICS.items()}
    name, *rest = metric.split(":")
    if name not in METRICS or len(rest) != len(METRICS[name].parameters):
        raise ValueError(f"one of {', '.join(forms.values())}")
    family = METRICS[name]
    try:
        parameters = [float(x) for x in rest]
    except ValueError:
        raise ValueError(f"{forms[name]} with numbers") from None
    if not family.allowed(*parameters):
        raise ValueError(f"{forms[name]} with {family.limits}")
    return family, parameters
