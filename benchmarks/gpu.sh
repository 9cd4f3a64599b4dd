#!/usr/bin/env bash
# Everything that needs a GPU, in one command of at most eight minutes after the installation: benchmarks/gpu.sh [flags of gpu.py]
set -euo pipefail
cd "$(dirname "$0")/.."
pip install -q -c constraints.txt -e ".[cuda13,warp]"
exec timeout --signal=INT 480 python benchmarks/gpu.py "$@"
