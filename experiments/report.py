"""Report on sweeps: python experiments/report.py STUDY …"""

import sys

from dgae_jax.cli.report import report

if __name__ == "__main__":
    sys.exit(report())
