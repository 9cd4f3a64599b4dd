"""Train all of a study: python experiments/reproduce.py STUDY"""

import sys

from dgae_jax.cli.reproduce import main

if __name__ == "__main__":
    sys.exit(main())
