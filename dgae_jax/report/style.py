"""How algorithms look, everywhere: a colour for each way to update the policy, dashed where the critic is scalar.

The colours are those of Okabe and Ito, which people with any colour vision tell apart; on paper without colours the dashes remain.
"""

from typing import NamedTuple

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.parts import is_distribution

COLOURS = {"clip": "#0072B2", "trust-region": "#D55E00", "gradient": "#009E73"}
OWN = "#56B4E9"
"""For updates of somebody's own."""

MARKERS = ("", "o", "s", "^", "D", "v", "P", "X")
"""For settings that differ from the first ones of the algorithm, and for rows of somebody's own that would look like another."""

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
    row = ALGORITHMS[algo]
    colour, several = COLOURS.get(row.policy_update, OWN), is_distribution(row.critic)
    alike = [
        n
        for n, other in ALGORITHMS.items()
        if (other.policy_update, is_distribution(other.critic)) == (row.policy_update, several)
    ]
    marker = MARKERS[(number + alike.index(algo)) % len(MARKERS)]
    return Look(colour, "-" if several else "--", marker, colour if several else "white")
