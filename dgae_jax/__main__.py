"""`python -m dgae_jax COMMAND …` is `dgae COMMAND …`."""

import sys

from dgae_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
