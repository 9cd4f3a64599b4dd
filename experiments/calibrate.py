"""Compare critics with observed returns: python experiments/calibrate.py RUN_DIR …"""

import sys

from dgae_jax.cli.evaluate import calibrate

if __name__ == "__main__":
    sys.exit(calibrate())
