"""Fit a value distribution to a finished policy: python experiments/refit.py RUN_DIR"""

import sys

from dgae_jax.cli.evaluate import refit

if __name__ == "__main__":
    sys.exit(refit())
