"""Search for settings: python experiments/tune.py --env hopper --algo dppo --trials 50"""

import sys

from dgae_jax.cli.tune import tune

if __name__ == "__main__":
    sys.exit(tune())
