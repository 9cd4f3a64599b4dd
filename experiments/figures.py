"""Draw the figures of the paper that need no training: python experiments/figures.py --out figures"""

import sys

from dgae_jax.cli.figures import main

if __name__ == "__main__":
    sys.exit(main())
