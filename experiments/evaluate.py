"""Evaluate a trained run: python experiments/evaluate.py RUN_DIR"""

import sys

from dgae_jax.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
