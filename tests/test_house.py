"""The layout of the package, and what importing it does."""

import re
import subprocess
import sys
import tomllib

from tests.helpers import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
LAYERS = PROJECT["tool"]["importlinter"]["contracts"][0]["layers"]


def test_every_folder_is_a_layer():
    folders = {path.parent.name for path in (ROOT / "dgae_jax").glob("*/__init__.py")}
    assert folders == set(re.findall(r"dgae_jax\.(\w+)", " ".join(LAYERS)))


def test_importing_prints_nothing_and_is_light():
    heavy = {"matplotlib", "gymnasium", "flask", "tyro", "IPython"}
    program = f"""
import sys; sys.modules['warp'] = None
import dgae_jax; assert not {heavy} & set(sys.modules)
import dgae_jax.envs.brax, dgae_jax.run.api"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
