"""The house as its plans say: rooms, sizes, and what imports what."""

import ast
import re
import subprocess
import sys
import tomllib

import pytest

from tests.helpers import ROOT

MODULES = sorted((ROOT / "dgae_jax").rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
LAYERS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][
    0
]["layers"]
ROOMS = re.findall(r"dgae_jax\.(\w+)", " ".join(LAYERS))


def test_the_rooms_are_the_folders_of_the_package_and_listed_in_order():
    folders = {
        path.name
        for path in (ROOT / "dgae_jax").iterdir()
        if path.is_dir() and path.name != "__pycache__"
    }
    assert folders == set(ROOMS)
    listed = (
        (ROOT / "docs" / "contributing.md")
        .read_text()
        .partition("## Rooms")[2]
        .partition("\n## ")[0]
    )
    firsts = [line.split("|")[1] for line in listed.splitlines() if line.startswith("| `")]
    assert re.findall(r"`(\w+)`", "".join(firsts)) == ROOMS


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_has_a_docstring_and_at_most_250_lines(path):
    text = path.read_text()
    assert ast.get_docstring(ast.parse(text))
    assert text.count("\n") <= 250


def test_no_test_imports_another_test_file():
    for path in TESTS:
        assert not re.search(
            r"^(from|import) tests\S*\.test_|^from tests\S* import test_",
            path.read_text(),
            re.MULTILINE,
        ), path


@pytest.mark.parametrize("module", ["envs.brax", "learn.normalizers", "run.api"])
def test_importing_a_module_prints_nothing_where_warp_is_not_installed(module):
    program = f"import sys; sys.modules['warp'] = None; import dgae_jax.{module}"
    assert (
        subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        ).stdout
        == ""
    )
