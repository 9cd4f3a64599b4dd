"""Output never ends a run; a notebook shows one page."""

import base64
import contextlib
import errno
import io
import os
import pty
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.image import imread

from dgae_jax.run import terminal
from dgae_jax.run.logger import RunLogger
from dgae_jax.run.options import RunOptions
from dgae_jax.run.terminal import Page, Reporter
from tests.helpers import ROOT, TINY
from tests.runs import SMALL


class Full(io.StringIO):
    """A full disk."""

    def write(self, text):
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("stream", [None, Full()])
def test_failed_write_costs_the_line(stream, monkeypatch):
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "stderr", stream)
    terminal.say("a")
    terminal.warn("b")
    with Reporter(100) as reporter:
        reporter.update(100, 1.0, None)


def train(run_dir, shell="", **how):
    """Start the command on a tiny run, with its streams as the shell says."""
    flags = ["--run-dir", run_dir, "--total-steps", "128", "--algo", "ppo", "--episodes", "1"]
    script = f'"$0" experiments/train.py "$@" {shell}'
    argv = ["bash", "-c", script, sys.executable, *map(str, flags), *TINY]
    return subprocess.Popen(argv, cwd=ROOT, **how)


def assert_whole(process, run_dir):
    assert process.wait(300) == 0
    assert (run_dir / "evaluation.json").exists()


@pytest.mark.parametrize(
    "shell", [">/dev/full 2>/dev/full", pytest.param("| head -n 1", marks=pytest.mark.slow)]
)
def test_run_survives_its_streams(shell, tmp_path):
    assert_whole(train(tmp_path / "run", shell), tmp_path / "run")


@pytest.mark.parametrize("hung_up", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_live_bar_survives_an_old_or_closed_terminal(hung_up, tmp_path):
    master, slave = pty.openpty()
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "TERM": "xterm"}
    process = train(tmp_path / "run", stdout=slave, stderr=slave, env=environment)
    os.close(slave)
    shown = os.read(master, 1000)
    with contextlib.suppress(OSError):  # the other end is closed
        while not hung_up:
            shown += os.read(master, 1000)
    os.close(master)
    assert_whole(process, tmp_path / "run")
    if not hung_up:
        assert b"Traceback" not in shown
        assert b"128 of 128 steps" in shown


@pytest.fixture
def cell(monkeypatch):
    """Outputs of a notebook's cell, as IPython's `display` is told to make them."""
    pytest.importorskip("IPython.display")
    history = []

    def display(output, **_):
        history.append(output)
        return SimpleNamespace(update=display)

    monkeypatch.setattr("IPython.display.display", display)
    return history


def test_page_has_text_and_later_the_curve(cell, capsys):
    pictures = iter([None, b"first", b"last"])
    with Reporter(100, page=Page(lambda _: next(pictures))) as reporter:
        reporter.watch("compiling")
        reporter.watch("10 of 100 steps")  # a moment later: nothing is drawn
        reporter.page.due = 0.0
        reporter.watch("20 of 100 steps")
    assert [output.data for output in cell] == ["", "compiling", b"first", b"last"]
    with pytest.raises(MemoryError), reporter:
        raise MemoryError  # a failed run is not drawn again
    assert len(cell) == 4
    assert capsys.readouterr() == ("", "")


def test_progress_is_in_the_picture(tmp_path):
    with RunLogger(tmp_path, SMALL, RunOptions(), 0) as run:
        assert run.picture("nothing yet") is None
        run.metrics.append({"episode_return": np.ones((2, 1))}, 2, 1.0)
        pictures = [imread(io.BytesIO(run.picture(text))) for text in ("", "128 of 256 steps")]
    assert pictures[0].shape == pictures[1].shape == (600, 960, 4)
    assert not np.array_equal(*pictures)


PROGRAM = """
import dgae_jax as dg
from tests.runs import QUIET, small

chosen = {"cache_dir": QUIET.cache_dir, "episodes": 1, "checkpoint_every": QUIET.checkpoint_every}
dg.train(small(), quiet=True, **chosen)
print("loud")
run = dg.train(small(), **chosen)
"""


@pytest.mark.slow
def test_real_kernel_shows_one_picture_and_nothing_if_quiet():
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(PROGRAM)])
    nbclient.NotebookClient(book, timeout=300).execute()
    budget, picture = book.cells[0].outputs
    assert budget["text"].startswith("loud\nhopper-v4 ppo on native: ")
    assert budget["text"].count("\n") == 2
    assert picture["output_type"] == "display_data"
    assert sorted(picture["data"]) == ["image/png", "text/plain"]
    image = base64.b64decode(picture["data"]["image/png"])
    assert imread(io.BytesIO(image)).shape == (600, 960, 4)
