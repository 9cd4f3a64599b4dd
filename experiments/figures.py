"""Draw the figures of the paper that need no training: python experiments/figures.py"""

import sys

from dgae_jax.cli.export import figures

if __name__ == "__main__":
    sys.exit(figures())
