"""The notebooks as they are committed; `.ci/run` executes them."""

import json
import re

import pytest

from tests.helpers import ROOT

EACH = pytest.mark.parametrize(
    "path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem
)


@EACH
def test_outputs_are_committed_without_errors(path):
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    assert any(cell["outputs"] for cell in cells)
    assert not [each for cell in cells for each in cell["outputs"] if "traceback" in each]
    assert path.stat().st_size < 300_000


@EACH
def test_links_resolve(path):
    cells = json.loads(path.read_text())["cells"]
    text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", text):
        assert (path.parent / target).exists(), target
