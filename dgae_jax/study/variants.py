"""Questions for a study: tables of variants, each an algorithm and the flags in which it departs from its preset."""

SCALAR = {
    "scalar": "ppo",
    "scalar-one-step": "ppo --critic.target bellman",
    "huber": "dppo --critic.quantiles 1 --critic.target lambda-return",
    "huber-one-step": "dppo --critic.quantiles 1 --critic.target bellman",
}
"""One value: half the squared error, or the Huber loss, which is what the quantile-Huber loss is for K = 1."""

DISTRIBUTIONAL = {
    "sr-lambda": "dppo",
    "lambda-return": "dppo --critic.target lambda-return",
    "lambda-shift": "dppo --critic.target lambda-shift",
    "bellman": "dppo --critic.target bellman",
    "bellman-frozen": "dppo --critic.target bellman-frozen",
    "quantiles-1": "dppo --critic.quantiles 1",
    "quantiles-8": "dppo --critic.quantiles 8",
    "kappa-0.01": "dppo --critic.kappa 0.01",
    "kappa-0.1": "dppo --critic.kappa 0.1",
    "matched-scale": "dppo --critic.max-grad-norm 16",
}
"""A distribution. The loss of 64 quantiles is a sum with weights of ½ on average, 32 times the scalar one; Adam does not see the
scale of a loss, but the bound of the gradient's norm, 0.5, does: 32 · 0.5 = 16 bounds both alike."""

_MONTE_CARLO = "dppo --critic.target monte-carlo --critic.kappa 0.01 --critic.epochs 3"

CALIBRATED = {
    "monte-carlo-64": f"{_MONTE_CARLO} --num-envs 32 --num-steps 64",
    "monte-carlo-128": f"{_MONTE_CARLO} --num-envs 16 --num-steps 128",
}
"""A critic that is told how the return went on, by rollouts of 64 and 128 steps."""

NOISE = "--noise.reward 0.5 --noise.action 0.1"
"""Of rewards around 3 and actions within ±1."""


def _noisy(variants: dict[str, str]) -> dict[str, str]:
    return {f"{name}+noise": f"{words} {NOISE}" for name, words in variants.items()}


def _preferences() -> dict[str, str]:
    return {
        f"{metric.replace(':', '-')}-lambda-{lam}+noise": f"dppo --metric {metric} --gae-lambda {lam} {NOISE}"
        for metric in ("mean", "cvar:0.25")
        for lam in (0.0, 0.5, 0.95, 1.0)
    }


VARIANTS: dict[str, dict[str, str]] = {
    "attribution": {**SCALAR, **DISTRIBUTIONAL},
    "attribution-noise": _noisy({**SCALAR, **DISTRIBUTIONAL}),
    "calibration": CALIBRATED,
    "risk": _preferences(),
}
"""What the gain of distributional critics is made of, with and without noise on the task; what makes their distributions hold; what a
preference for safe returns buys."""
