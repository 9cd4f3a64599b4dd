"""The package as it is installed needs nothing of the repository."""

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest

from tests.helpers import ROOT

SMALL = (
    "--total-steps 2048 --num-envs 8 --num-steps 16 --policy.minibatches 4 --critic.minibatches 4"
)
RUN = f"train --env hopper --run-dir run --episodes 2 {SMALL}"
STUDY = f"reproduce study --envs hopper --algos ppo --seeds 0 --physics native --episodes 2 {SMALL}"
MADE = {
    RUN: "run/evaluation.json",
    "evaluate run --episodes 2": "run/evaluation-gymnasium.json",
    "export run --to npz": "run/export/npz/policy.npz",
    "figures --only transport": "figures/transport.png",
    STUDY: "study/results.jsonl",
    "report study --published": "study/report/report.html",
}


@pytest.mark.slow
def test_an_installed_wheel_trains_exports_and_reports(tmp_path):
    site, place = tmp_path / "site", tmp_path / "place"
    place.mkdir()
    pip = [sys.executable, "-m", "pip"]
    build = ["--no-build-isolation"] * (find_spec("hatchling") is not None)
    wheel = [*pip, "wheel", ".", "--no-deps", "--quiet", "--wheel-dir", str(tmp_path), *build]
    subprocess.run(wheel, cwd=ROOT, check=True)
    name = str(next(tmp_path.glob("dgae_jax-*.whl")))
    install = [*pip, "install", "--no-deps", "--quiet", "--target", str(site), name]
    subprocess.run(install, check=True)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    for words, made in MADE.items():
        program = [sys.executable, str(site / "bin" / "dgae"), *words.split()]
        subprocess.run(program, cwd=place, env=environment, check=True, capture_output=True)
        assert (place / made).stat().st_size, words
    assert (site / "dgae_jax" / "py.typed").exists()
