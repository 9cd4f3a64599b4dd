"""Questions of a sweep: for each a table of variants, as an algorithm and changed settings."""

from typing import Any

Variant = tuple[str, dict[str, Any]]
"""An algorithm, and the settings by path in which the variant departs from its preset."""

SCALAR: dict[str, Variant] = {
    "scalar": ("ppo", {}),
    "scalar-one-step": ("ppo", {"critic.target": "bellman"}),
    "huber": ("dppo", {"critic.quantiles": 1, "critic.target": "lambda-return"}),
    "huber-one-step": ("dppo", {"critic.quantiles": 1, "critic.target": "bellman"}),
}
"""Critics of one value: squared error, or the Huber loss (quantile-Huber with K = 1)."""

DISTRIBUTIONAL: dict[str, Variant] = {
    "sr-lambda": ("dppo", {}),
    "lambda-return": ("dppo", {"critic.target": "lambda-return"}),
    "lambda-shift": ("dppo", {"critic.target": "lambda-shift"}),
    "bellman": ("dppo", {"critic.target": "bellman"}),
    "bellman-frozen": ("dppo", {"critic.target": "bellman-frozen"}),
    "quantiles-1": ("dppo", {"critic.quantiles": 1}),
    "quantiles-8": ("dppo", {"critic.quantiles": 8}),
    "kappa-0.01": ("dppo", {"critic.kappa": 0.01}),
    "kappa-0.1": ("dppo", {"critic.kappa": 0.1}),
    # 64 quantiles weigh the loss 32 times as much, which Adam does not see but max_grad_norm does
    "matched-scale": ("dppo", {"critic.max_grad_norm": 16.0}),
}

MONTE_CARLO = {"critic.target": "monte-carlo", "critic.kappa": 0.01, "critic.epochs": 3}

CALIBRATION: dict[str, Variant] = {
    "monte-carlo-64": ("dppo", {**MONTE_CARLO, "num_envs": 32, "num_steps": 64}),
    "monte-carlo-128": ("dppo", {**MONTE_CARLO, "num_envs": 16, "num_steps": 128}),
}
"""Critics fitted to Monte Carlo returns, with rollouts of 64 and 128 steps."""

NOISE = {"noise.reward": 0.5, "noise.action": 0.1}
"""Rewards are around 3, actions within ±1."""

RISK: dict[str, Variant] = {
    f"{metric.replace(':', '-')}-lambda-{gae_lambda}": (
        "dppo",
        {"metric": metric, "gae_lambda": gae_lambda},
    )
    for metric in ("mean", "cvar:0.25")
    for gae_lambda in (0.0, 0.5, 0.95, 1.0)
}


def _noisy(table: dict[str, Variant]) -> dict[str, Variant]:
    return {f"{name}+noise": (algo, {**values, **NOISE}) for name, (algo, values) in table.items()}


VARIANTS: dict[str, dict[str, Variant]] = {
    "attribution": {**SCALAR, **DISTRIBUTIONAL},
    "attribution-noise": _noisy({**SCALAR, **DISTRIBUTIONAL}),
    "calibration": CALIBRATION,
    "risk": _noisy(RISK),
}
"""By question: what the gain of distributional critics comes from, without and with noise on the
task; what makes their distributions calibrated; what a risk-averse metric costs and gains."""
