"""The layout of the package, and what importing it does."""

import ast
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


def test_every_module_has_a_docstring():
    for path in (ROOT / "dgae_jax").rglob("*.py"):
        assert ast.get_docstring(ast.parse(path.read_text())), path


def test_importing_prints_nothing_without_warp():
    program = "import sys; sys.modules['warp'] = None; import dgae_jax.envs.brax, dgae_jax.run.api"
    words = [sys.executable, "-c", program]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout == ""
