"""A run on several devices from the command line: CPU devices, in processes of their own."""

import json
import subprocess
import sys

import pytest

from tests.helpers import ROOT, TINY
from tests.runs import last, stopped_half_way, timeless


def train(*flags):
    command = [sys.executable, ROOT / "experiments" / "train.py", *map(str, flags)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_shared_run_that_stopped_half_way_ends_with_the_same_bits_on_as_many_devices_and_is_refused_on_others(
    tmp_path,
):
    whole, half = tmp_path / "whole", tmp_path / "half"
    flags = [
        *TINY,
        "--devices",
        "2",
        "--total-steps",
        "512",
        "--checkpoint-every",
        "256",
        "--episodes",
        "1",
    ]
    done = train(*flags, "--run-dir", whole)
    assert done.returncode == 0, done.stderr
    assert json.loads((whole / "manifest.json").read_text())["options"]["devices"] == 2
    stopped_half_way(whole, half)
    refused = train("--resume", half, "--devices", "1", *TINY[-2:])
    assert refused.returncode == 2
    assert "must go on where it began, or with --inexact; now devices 1 (was 2)" in refused.stderr
    assert train("--resume", half, *TINY[-2:]).returncode == 0
    assert last(half).read_bytes() == last(whole).read_bytes()
    assert timeless(half) == timeless(whole)


@pytest.mark.parametrize(
    ("devices", "reason"),
    [
        ("3", "devices 3: must be a number that divides num_envs 4 or num_seeds 1"),
        ("0", "devices 0: must be a whole number from 1 to"),
    ],
)
def test_a_number_of_devices_that_does_not_come_out_even_is_refused_in_one_line(
    devices, reason, tmp_path
):
    done = train(*TINY, "--devices", devices, "--run-dir", tmp_path / "run")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: --{reason}")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()
