"""Train a policy: python experiments/train.py --env hopper --algo dppo"""

import sys

from dgae_jax.cli.train import train

if __name__ == "__main__":
    sys.exit(train())
