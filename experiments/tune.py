"""Search for hyperparameters: python experiments/tune.py --env hopper --algo dppo"""

import sys

from dgae_jax.cli.tune import tune

if __name__ == "__main__":
    sys.exit(tune())
