"""The notebooks as they are committed; continuous integration runs them."""

import json
import re

import pytest

from tests.helpers import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CELLS = {
    path: [(cell, "".join(cell["source"])) for cell in json.loads(path.read_text())["cells"]]
    for path in NOTEBOOKS
}


def code(path):
    return [text for cell, text in CELLS[path] if cell["cell_type"] == "code"]


def test_there_are_four_and_each_is_as_long_as_a_notebook():
    assert [path.stem[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04"]
    assert all(len(code(path)) >= 8 for path in NOTEBOOKS)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_output_and_no_number_of_a_run_is_committed(path):
    for cell, _ in CELLS[path]:
        assert (cell.get("outputs", []), cell.get("execution_count")) == ([], None)


def test_all_begin_with_the_same_set_up_whose_address_is_one_variable():
    first = {code(path)[0] for path in NOTEBOOKS}
    assert len(first) == 1
    assert re.findall(r"^SOURCE = ", first.pop(), re.MULTILINE) == ["SOURCE = "]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_settings_come_from_presets(path):
    for copied in re.findall(
        r"\b(num_envs|num_steps|minibatches|learning_rate|epochs)=", "\n".join(code(path))
    ):
        pytest.fail(f"{copied} belongs to a preset")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_links_lead_somewhere(path):
    for target in re.findall(
        r"\]\((?!https?:)([^)#]+)",
        "\n".join(text for cell, text in CELLS[path] if cell["cell_type"] == "markdown"),
    ):
        assert (path.parent / target).exists(), target
