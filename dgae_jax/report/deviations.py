"""Where the tasks, settings and measurements depart from the paper's: the numbered list of docs/reproduction.md, or this short one."""

import re
from pathlib import Path

from dgae_jax.report.published import DOCS

SHORT = (
    "Targets of a distributional critic are SR(λ), the paper's are one-step (`--critic.target bellman`, or `--preset paper`).",
    "Networks have two hidden layers of 64, the paper's 256, on Ant 512; the standard deviation of actions is one learned vector, not an"
    " output of the network.",
    "Learning rates fall to zero; γ, λ and other settings that the paper leaves open are usual values, and γ is 0.9999 on Swimmer.",
    "TRPO's rollouts are as long as PPO's, the paper's have 25,000 samples, on Ant 50,000.",
    "Observations and rewards are scaled by running statistics for all algorithms; the paper does not say whether its are.",
    "Returns are those of the deterministic policy in Gymnasium's version of the task; the paper shows returns while training.",
)
"""What holds for the preset `tuned`; the settings of every cell say what was used."""


def deviations(path: Path = DOCS / "reproduction.md") -> list[str]:
    """One sentence or more per deviation, in Markdown."""
    listed = _numbered(path.read_text()) if path.is_file() else []
    return listed or list(SHORT)


def _numbered(text: str) -> list[str]:
    """The items of numbered lists, their lines joined."""
    items = re.findall(r"^\d+\. +(.+(?:\n(?: {2,}|\t)\S.*)*)", text, re.MULTILINE)
    return [re.sub(r"\s*\n\s*", " ", item) for item in items]
