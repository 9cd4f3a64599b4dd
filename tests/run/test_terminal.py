"""Output never ends a run; a notebook shows one page."""

import base64
import errno
import io
import os
import pty
import subprocess
import sys
import threading
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from matplotlib.image import imread

from dgae_jax.run import metrics, terminal
from dgae_jax.run.terminal import Page, Reporter
from tests.helpers import ROOT, TINY
from tests.runs import ITERATIONS


class Full(io.StringIO):
    """A full disk."""

    def write(self, text):
        raise OSError(errno.ENOSPC, "No space left on device")


class Latin(io.TextIOWrapper):
    """A terminal without Greek letters."""

    def __init__(self):
        super().__init__(io.BytesIO(), encoding="latin-1")


def closed():
    stream = io.StringIO()
    stream.close()
    return stream


@pytest.mark.parametrize("stream", [None, Full(), closed()])
def test_failed_write_costs_the_line(stream, monkeypatch):
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "stderr", stream)
    terminal.say("a")
    terminal.warn("b")
    with Reporter(100) as reporter:
        reporter.announce("compiling")
        reporter.update(100, 1.0, None)


def test_missing_characters_are_escaped(monkeypatch):
    stream = Latin()
    monkeypatch.setattr(sys, "stdout", stream)
    terminal.say("1.0 ± 0.5 – γ")
    assert stream.buffer.getvalue() == b"1.0 \xb1 0.5 \\u2013 \\u03b3\n"


def test_silenced_run_still_warns(capsys):
    with terminal.silenced():
        terminal.say("a")
        terminal.warn("b")
    terminal.say("c")
    assert capsys.readouterr() == ("c\n", "b\n")


def train(run_dir, shell="", **how):
    """Start the command on a tiny run, with its streams as the shell says."""
    flags = ["--run-dir", run_dir, "--total-steps", "128", "--algo", "ppo", "--episodes", "1"]
    script = f'exec "$0" experiments/train.py "$@" {shell}'
    argv = ["bash", "-c", script, sys.executable, *map(str, flags), *TINY]
    return subprocess.Popen(argv, cwd=ROOT, **how)


def assert_whole(process, run_dir):
    assert process.wait(300) == 0
    assert (run_dir / "evaluation.json").exists()


OLD = {**os.environ, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
ASCII = {**OLD, "PYTHONIOENCODING": "ascii"}


@pytest.mark.parametrize(
    ("shell", "environment"),
    [
        pytest.param(">/dev/full 2>/dev/full", OLD, marks=pytest.mark.slow),
        (">&- 2>&- <&-", OLD),
        pytest.param(">/dev/null", ASCII, marks=pytest.mark.slow),
    ],
)
def test_run_survives_its_streams(shell, environment, tmp_path):
    assert_whole(train(tmp_path / "run", shell, env=environment), tmp_path / "run")
    for name in ("metrics.jsonl", "evaluations.jsonl"):  # nothing that was printed went into a file
        lines = (tmp_path / "run" / name).read_bytes().splitlines()
        assert all(line.startswith(b'{"') for line in lines)


def test_run_survives_a_reader_that_ends(tmp_path):
    process = train(tmp_path / "run", stdout=subprocess.PIPE)
    assert b"hopper-v4 ppo" in process.stdout.readline()
    process.stdout.close()
    assert_whole(process, tmp_path / "run")


def read_all(master, shown):
    try:
        while True:
            shown.append(os.read(master, 1000))
    except OSError:  # the other end is closed
        return


@pytest.mark.parametrize("hung_up", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_live_bar_survives_an_old_or_closed_terminal(hung_up, tmp_path):
    master, slave = pty.openpty()
    environment = {**ASCII, "TERM": "xterm"}
    process = train(tmp_path / "run", stdout=slave, stderr=slave, env=environment)
    os.close(slave)
    shown = [os.read(master, 1000)]
    reader = threading.Thread(target=read_all, args=(master, shown))
    if hung_up:
        os.close(master)
    else:
        reader.start()
    assert_whole(process, tmp_path / "run")
    if not hung_up:
        reader.join()
        os.close(master)
        assert b"Traceback" not in b"".join(shown)
        assert b"128 of 128 steps" in b"".join(shown)


class Output:
    """The output of a notebook cell, as IPython's `display` is told to make it."""

    def __init__(self):
        self.history = []

    def display(self, data, *, raw, metadata, display_id=True):
        assert (raw, display_id) == (True, True)
        self.history.append((data, metadata))
        return SimpleNamespace(update=self.display)


@pytest.fixture
def cell(monkeypatch):
    cell, ipython, display = Output(), ModuleType("IPython"), ModuleType("IPython.display")
    ipython.get_ipython = lambda: SimpleNamespace(kernel="a kernel")
    ipython.version_info = (9, 0)  # Matplotlib asks
    display.display = cell.display
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    return cell


def test_only_a_kernel_has_a_page(cell, monkeypatch):
    assert terminal.in_notebook()
    with terminal.silenced():
        assert not terminal.in_notebook()
    for shell in (SimpleNamespace(), None):  # IPython on a terminal, imported by a program
        monkeypatch.setattr(sys.modules["IPython"], "get_ipython", lambda shell=shell: shell)
        assert not terminal.in_notebook()
    monkeypatch.delitem(sys.modules, "IPython")
    assert not terminal.in_notebook()
    assert "IPython" not in sys.modules


def test_page_has_text_and_later_the_curve(cell, capsys):
    def curve():
        return metrics.learning_curve(np.arange(3), np.ones((3, 1)), "a run")

    figures = iter([None, curve(), curve()])
    with Reporter(100, page=Page(lambda: next(figures))) as reporter:
        reporter.announce("compiling")
        reporter.announce("10 of 100 steps")
        for steps in range(20, 30):
            reporter.update(steps, 5.0, 1.0)  # a moment later: nothing is drawn
    (text, _), (first, shown), (end, _) = cell.history
    assert text == {"text/plain": "compiling"}
    assert first["text/plain"] == "a run 10 of 100 steps"
    assert end["text/plain"] == "a run"
    assert shown == {"image/png": {"width": terminal.PICTURE_WIDTH}}
    pictures = [imread(io.BytesIO(base64.b64decode(each["image/png"]))) for each in (first, end)]
    assert pictures[0].shape == pictures[1].shape == (600, 960, 4)
    assert not np.array_equal(*pictures)  # the text is in the picture
    assert capsys.readouterr() == ("", "")


def test_drawing_takes_a_tenth_of_the_time(cell, monkeypatch):
    now = [0.0]

    def draw():
        now[0] += 2.0  # a slow machine

    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    page = Page(draw)
    for now[0] in np.arange(0.0, 101.0):
        page.show("text")
    assert len(cell.history) == 6  # at 0, 20, 40, …, 100: 2 s of each 20


def test_failed_run_is_not_drawn_again(cell):
    reporter = Reporter(page=Page(lambda: None))
    reporter.announce("evaluating")
    reporter.__exit__(MemoryError)
    assert len(cell.history) == 1
    reporter.__exit__(None)
    assert len(cell.history) == 2


PROGRAM = f"""
import dgae_jax as dg
from tests.runs import QUIET, small

chosen = {{"cache_dir": QUIET.cache_dir, "episodes": 1, "checkpoint_every": QUIET.checkpoint_every}}
assert len(dg.train(small(), quiet=True, **chosen).metrics) == {ITERATIONS}
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
