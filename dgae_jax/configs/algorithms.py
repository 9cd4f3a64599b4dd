"""The table: an algorithm's name is a row of parts, and nothing else depends on the name."""

from typing import NamedTuple


class Row(NamedTuple):
    """What distinguishes one name from another; each part is a key of the table named here."""

    critic: str
    """`critics.CRITICS`: one value, or quantiles."""
    residual: str
    """`critics.RESIDUALS`: the one thing DGAE changes."""
    target: str
    """`critics.TARGETS`: what the critic is fitted to."""
    update: str
    """`updates.UPDATES`: how the policy moves."""


TABLE = {
    "ppo": Row("scalar", "td", "lambda-return", "clip"),
    "dppo": Row("quantile", "distributional", "sr-lambda", "clip"),
    "trpo": Row("scalar", "td", "lambda-return", "trust-region"),
    "dtrpo": Row("quantile", "distributional", "sr-lambda", "trust-region"),
    "a2c": Row("scalar", "td", "lambda-return", "gradient"),
    "da2c": Row("quantile", "distributional", "sr-lambda", "gradient"),
}
