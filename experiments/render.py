"""Make a film of a trained run: python experiments/render.py RUN_DIR"""

import sys

from dgae_jax.cli.render import render

if __name__ == "__main__":
    sys.exit(render())
