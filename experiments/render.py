"""Make a film of a trained run: python experiments/render.py RUN_DIR"""

import sys

from dgae_jax.cli.render import main

if __name__ == "__main__":
    sys.exit(main())
