#!/usr/bin/env bash
# All measurements that need a GPU, in at most eight minutes: benchmarks/gpu.sh [flags of gpu.py]
set -euo pipefail
cd "$(dirname "$0")/.."
pip install -q -c constraints.txt -e ".[cuda13,warp]"
exec timeout --signal=INT 480 python benchmarks/gpu.py "$@"
