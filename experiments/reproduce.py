"""Train the runs of a sweep: python experiments/reproduce.py STUDY"""

import sys

from dgae_jax.cli.reproduce import reproduce

if __name__ == "__main__":
    sys.exit(reproduce())
