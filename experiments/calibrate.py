"""Compare critics with the returns that came: python experiments/calibrate.py RUN_DIR …"""

import sys

from dgae_jax.cli.calibrate import main

if __name__ == "__main__":
    sys.exit(main())
