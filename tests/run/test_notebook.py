"""Runs in a notebook."""

import base64
import io
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from matplotlib.image import imread

from dgae_jax.run import metrics, terminal
from dgae_jax.run.terminal import Page, Reporter
from tests.runs import ITERATIONS

PROGRAM = f"""
import dgae_jax as dg
from tests.runs import QUIET, small

chosen = {{"cache_dir": QUIET.cache_dir, "episodes": 1, "checkpoint_every": QUIET.checkpoint_every}}
assert len(dg.train(small(), quiet=True, **chosen).metrics) == {ITERATIONS}
print("loud")
run = dg.train(small(), **chosen)
"""


class Cell:
    """The output of a cell, as IPython's `display` is told to make it."""

    def __init__(self):
        self.history = []

    def display(self, data, *, raw, metadata, display_id):
        assert (raw, display_id) == (True, True)
        self.history.append((data, metadata))
        return SimpleNamespace(
            update=lambda data, *, raw, metadata: self.history.append((data, metadata))
        )


@pytest.fixture
def cell(monkeypatch):
    cell, ipython, display = Cell(), ModuleType("IPython"), ModuleType("IPython.display")
    ipython.get_ipython = lambda: SimpleNamespace(kernel="a kernel")
    ipython.version_info = (9, 0)  # Matplotlib asks
    display.display = cell.display
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    return cell


def test_a_kernel_that_may_speak_has_a_page_and_nothing_else_has(cell, monkeypatch):
    assert terminal.in_notebook()
    with terminal.silenced():
        assert not terminal.in_notebook()
    monkeypatch.setattr(
        sys.modules["IPython"], "get_ipython", lambda: SimpleNamespace()
    )  # IPython on a terminal
    assert not terminal.in_notebook()
    monkeypatch.setattr(
        sys.modules["IPython"], "get_ipython", lambda: None
    )  # imported by a program
    assert not terminal.in_notebook()
    monkeypatch.delitem(sys.modules, "IPython")
    assert not terminal.in_notebook()
    assert "IPython" not in sys.modules


def test_one_output_has_words_until_there_is_a_return_and_then_the_curve(cell, capsys):
    figures = iter(
        [None, *(metrics.learning_curve(np.arange(3), np.ones((3, 1)), "a run") for _ in range(2))]
    )
    with Reporter(100, page=Page(lambda: next(figures))) as reporter:
        reporter.announce("compiling")
        reporter.announce("10 of 100 steps")
        for steps in range(20, 30):
            reporter.update(steps, 5.0, 1.0)  # a moment later: nothing is drawn
    (words, _), (first, shown), (last, _) = cell.history
    assert words == {"text/plain": "compiling"}
    assert first["text/plain"] == "a run 10 of 100 steps"
    assert last["text/plain"] == "a run"
    assert shown == {"image/png": {"width": terminal.WIDTH}}
    pictures = [imread(io.BytesIO(base64.b64decode(each["image/png"]))) for each in (first, last)]
    assert pictures[0].shape == pictures[1].shape == (600, 960, 4)
    assert not np.array_equal(*pictures)  # the words are in the picture
    assert capsys.readouterr() == ("", "")


def test_drawing_takes_a_tenth_of_the_time_at_most(cell, monkeypatch):
    now = [0.0]

    def draw():
        now[0] += 2.0  # a slow machine

    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    page = Page(draw)
    for now[0] in np.arange(0.0, 101.0):
        page.show("words")
    assert len(cell.history) == 6  # at 0, 20, 40, …, 100: 2 s of each 20


def test_a_run_that_failed_is_not_drawn_again(cell):
    reporter = Reporter(page=Page(lambda: None))
    reporter.announce("evaluating")
    reporter.__exit__(MemoryError)
    assert len(cell.history) == 1
    reporter.__exit__(None)
    assert len(cell.history) == 2


@pytest.mark.slow
def test_a_run_in_a_real_kernel_leaves_one_picture_and_a_quiet_one_nothing(monkeypatch):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(PROGRAM)])
    nbclient.NotebookClient(book, timeout=300).execute()
    budget, picture = book.cells[0].outputs
    assert budget["text"].startswith("loud\nhopper-v4 ppo on native: ")
    assert budget["text"].count("\n") == 2
    assert (picture["output_type"], sorted(picture["data"])) == (
        "display_data",
        ["image/png", "text/plain"],
    )
    assert imread(io.BytesIO(base64.b64decode(picture["data"]["image/png"]))).shape == (600, 960, 4)
