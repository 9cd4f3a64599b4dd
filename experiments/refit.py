"""TrainableState a value distribution to a finished policy: python experiments/refit.py RUN_DIR"""

import sys

from dgae_jax.cli.refit import main

if __name__ == "__main__":
    sys.exit(main())
