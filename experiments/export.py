"""Export a trained policy: python experiments/export.py RUN_DIR --to npz"""

import sys

from dgae_jax.cli.export import export

if __name__ == "__main__":
    sys.exit(export())
