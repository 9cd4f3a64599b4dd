"""The six algorithms: each name is a row of parts, and nothing else depends on the name."""

from typing import Literal, NamedTuple

AlgorithmName = Literal["ppo", "dppo", "trpo", "dtrpo", "a2c", "da2c"]


class Row(NamedTuple):
    """Parts of an algorithm; each is a key of a table in `configs.parts`."""

    critic: str
    residual: str
    """TD error: the one thing that DGAE changes."""
    target: str
    policy_update: str


ALGORITHMS: dict[str, Row] = {
    "ppo": Row("scalar", "td", "lambda-return", "clip"),
    "dppo": Row("quantile", "distributional", "sr-lambda", "clip"),
    "trpo": Row("scalar", "td", "lambda-return", "trust-region"),
    "dtrpo": Row("quantile", "distributional", "sr-lambda", "trust-region"),
    "a2c": Row("scalar", "td", "lambda-return", "gradient"),
    "da2c": Row("quantile", "distributional", "sr-lambda", "gradient"),
}
