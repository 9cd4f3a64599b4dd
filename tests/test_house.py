"""The layout of the package, what importing it does, and the package as it is installed."""

import os
import re
import subprocess
import sys
import tomllib
from importlib.util import find_spec

import pytest

from tests.helpers import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
LAYERS = PROJECT["tool"]["importlinter"]["contracts"][0]["layers"]

SMALL = (
    "--total-steps 256 --num-envs 8 --num-steps 16 --policy.minibatches 4 --critic.minibatches 4"
)
MADE = {
    f"train --run-dir run {SMALL}": "run/evaluation.json",
    "evaluate run --episodes 2": "run/evaluation-gymnasium.json",
    "export run --to npz": "run/export/npz/policy.npz",
    "figures --only transport": "figures/transport.png",
    f"reproduce study --envs hopper --algos ppo --seeds 0 {SMALL}": "study/results.jsonl",
    "report study --published": "study/report/report.html",
}
"""Commands in order, and a file that each makes."""


def test_every_folder_is_a_layer():
    folders = {path.parent.name for path in (ROOT / "dgae_jax").glob("*/__init__.py")}
    assert folders == set(re.findall(r"dgae_jax\.(\w+)", " ".join(LAYERS)))


def test_importing_prints_nothing_and_is_light():
    heavy = {"matplotlib", "gymnasium", "flask", "tyro", "IPython"}
    program = f"""
import sys; sys.modules['warp'] = None
import dgae_jax; assert not {heavy} & set(sys.modules)
import dgae_jax.envs.brax, dgae_jax.run.api
import mujoco; assert mujoco.get_mju_user_warning() is None"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


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
