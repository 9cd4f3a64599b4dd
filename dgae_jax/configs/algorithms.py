"""The six algorithms: each name is a row of parts, and nothing else depends on the name."""

from typing import Literal, NamedTuple

AlgorithmName = Literal["ppo", "dppo", "trpo", "dtrpo", "a2c", "da2c"]


class Row(NamedTuple):
    """Parts of an algorithm; each is a key of a table in `configs.parts`."""

    critic: str
    """Key of `CRITICS`: one value, or quantiles."""
    residual: str
    """Key of `RESIDUALS`: the TD error, the one thing that DGAE changes."""
    target: str
    """Key of `TARGETS`: what the critic is fitted to."""
    policy_update: str
    """Key of `UPDATES`: how the policy improves."""


ALGORITHMS: dict[str, Row] = {
    "ppo": Row("scalar", "td", "lambda-return", "clip"),
    "dppo": Row("quantile", "distributional", "sr-lambda", "clip"),
    "trpo": Row("scalar", "td", "lambda-return", "trust-region"),
    "dtrpo": Row("quantile", "distributional", "sr-lambda", "trust-region"),
    "a2c": Row("scalar", "td", "lambda-return", "gradient"),
    "da2c": Row("quantile", "distributional", "sr-lambda", "gradient"),
}
