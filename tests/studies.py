"""Small studies, for the tests of what trains many runs."""

import json
import subprocess
import sys

from dgae_jax.run import metrics
from tests.helpers import ROOT, TINY

SHAPE = [
    *TINY,
    "--envs",
    "hopper",
    "--algos",
    "ppo",
    "dppo",
    "--seeds",
    "0",
    "1",
    "--total-steps",
    str(64 * 10),
    "--episodes",
    "2",
]
"""Four cells of ten iterations."""

TIMES = ("seconds", "samples_per_second", "command")
"""What differs between two studies of the same cells."""


def start(study, *more):
    """The real command."""
    words = [
        sys.executable,
        "experiments/reproduce.py",
        str(study),
        *SHAPE,
        "--checkpoint-every",
        "320",
        *more,
    ]
    return subprocess.Popen(
        words, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def finish(process):
    """Exit code, lines and errors."""
    out, err = process.communicate(timeout=500)
    return process.returncode, out.splitlines(), err


def rows(study):
    """Of the results, without their times."""
    return [
        {k: v for k, v in row.items() if k not in TIMES}
        for row in metrics.read(study / "results.jsonl")
    ]


def cells(study):
    """Names of a study's cells."""
    return list(json.loads((study / "study.json").read_text())["cells"])
