"""Evaluate a trained run: python experiments/evaluate.py RUN_DIR"""

import sys

from dgae_jax.cli.evaluate import evaluate

if __name__ == "__main__":
    sys.exit(evaluate())
