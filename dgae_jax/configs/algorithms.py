"""The table: an algorithm's name is a row of parts, and nothing else depends on the name."""

from typing import NamedTuple


class Row(NamedTuple):
    """What distinguishes one name from another; each part is a key of a table in `configs.parts`."""

    critic: str
    """`CRITICS`: one value, or quantiles."""
    residual: str
    """`RESIDUALS`: the one thing DGAE changes."""
    target: str
    """`TARGETS`: what the critic is fitted to."""
    policy_update: str
    """`UPDATES`: how the policy improves."""


TABLE = {
    "ppo": Row("scalar", "td", "lambda-return", "clip"),
    "dppo": Row("quantile", "distributional", "sr-lambda", "clip"),
    "trpo": Row("scalar", "td", "lambda-return", "trust-region"),
    "dtrpo": Row("quantile", "distributional", "sr-lambda", "trust-region"),
    "a2c": Row("scalar", "td", "lambda-return", "gradient"),
    "da2c": Row("quantile", "distributional", "sr-lambda", "gradient"),
}
