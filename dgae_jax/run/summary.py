"""Returns of episodes in a few numbers, and in one line."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dgae_jax.maths.statistics import bootstrap_interval, iqm


@np.errstate(invalid="ignore")  # a return that is not finite makes numbers that are not either
def summary(returns: np.ndarray) -> dict[str, Any]:
    """Mean, standard deviation, tails and quantiles of returns [E], and each of them."""
    return {
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_cvar": {str(share): mean_of_worst(returns, share) for share in (0.05, 0.1, 0.25)},
        "return_quantiles": {
            str(q): float(np.quantile(returns, q)) for q in (0.05, 0.25, 0.5, 0.75, 0.95)
        },
        "returns": [round(float(r), 4) for r in returns],
    }


def mean_of_worst(returns: np.ndarray, share: float) -> float:
    """CVaR: the mean of the lowest `share` of returns [E], of one at least."""
    return float(np.sort(returns)[: max(1, round(share * len(returns)))].mean())


def over_seeds(returns: list[np.ndarray]) -> dict[str, Any]:
    """What separates trained seeds: the mean of their mean returns, its spread, and how sure it is.

    `seeds_std` is the sample standard deviation (n − 1) of the seeds' means; `interval` and `iqm_interval` are 95 % percentile
    bootstrap intervals over seeds, of the mean and of the interquartile mean. With few seeds they are too narrow.
    """
    means = np.array([each.mean() for each in returns])
    key, ours = jax.random.key(0), jnp.asarray(means, jnp.float32)
    return {
        "seeds_mean": float(means.mean()),
        "seeds_std": float(means.std(ddof=1)),
        "interval": [float(x) for x in bootstrap_interval(key, ours, jnp.mean)],
        "iqm": float(iqm(ours)),
        "iqm_interval": [float(x) for x in bootstrap_interval(key, ours)],
    }


def describe(result: dict[str, Any]) -> str:
    """An evaluation in one line."""
    seeds, where = (
        len(result["seeds"]),
        f"of the deterministic policy in {result['env']} ({result['engine']})",
    )
    if seeds == 1:
        return f"return {result['return_mean']:,.1f} ± {result['return_std']:,.1f} over {counted(result['episodes'], 'episode')} {where}"
    low, high = result["interval"]
    spread = f"standard deviation {result['seeds_std']:,.1f} over seeds, 95 % interval of the mean {low:,.1f} to {high:,.1f}"
    return f"return {result['seeds_mean']:,.1f}, mean of {seeds} seeds × {counted(result['episodes'] // seeds, 'episode')} {where}; {spread}"


def counted(number: int, noun: str) -> str:
    """A number of things, with the plural unless it is one."""
    return f"{number} {noun}" + "s" * (number != 1)
