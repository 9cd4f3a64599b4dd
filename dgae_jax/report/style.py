"""How algorithms look, everywhere: a colour for each way to update the policy, dashed where the critic is scalar.

The colours are those of Okabe and Ito, which people with any colour vision tell apart; on paper without colours the dashes remain.
"""

from typing import NamedTuple

from dgae_jax.configs.algorithms import TABLE

COLOURS = {"clip": "#0072B2", "trust-region": "#D55E00", "gradient": "#009E73"}
LINES = {"scalar": "--", "quantile": "-"}
MARKERS = ("", "o", "s", "^", "D", "v", "P", "X")
"""For settings that differ from the first ones of the algorithm."""

INK, FAINT = "#222222", "#777777"
OTHER = "#CC79A7"
"""What is nobody's: published results."""


class Look(NamedTuple):
    """Of a line, and of the dot that stands for it."""

    colour: str
    line: str
    marker: str
    fill: str
    """Inside a dot: hollow for a scalar critic."""


def look(algo: str, number: int = 0) -> Look:
    """Of an algorithm's first settings, or of the others by their number."""
    row = TABLE[algo]
    colour, line = COLOURS[row.policy_update], LINES[row.critic]
    return Look(colour, line, MARKERS[number % len(MARKERS)], colour if line == "-" else "white")
