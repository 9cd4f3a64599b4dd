"""Make a video of a trained run: python experiments/render.py RUN_DIR"""

import sys

from dgae_jax.cli.export import render

if __name__ == "__main__":
    sys.exit(render())
