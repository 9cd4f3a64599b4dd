"""Printing never ends a run."""

import errno
import io
import os
import pty
import subprocess
import sys
import threading

import pytest

from dgae_jax.run import terminal
from dgae_jax.run.terminal import Reporter
from tests.helpers import ROOT, TINY


class Full(io.StringIO):
    """A disk that takes no more."""

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
def test_a_stream_that_takes_nothing_costs_the_line_and_nothing_else(stream, monkeypatch):
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "stderr", stream)
    terminal.say("a")
    terminal.warn("b")
    with Reporter(100) as reporter:
        reporter.announce("compiling")
        reporter.update(100, 1.0, None)


def test_what_an_encoding_lacks_is_written_as_escapes(monkeypatch):
    stream = Latin()
    monkeypatch.setattr(sys, "stdout", stream)
    terminal.say("1.0 ± 0.5 – γ")
    assert stream.buffer.getvalue() == b"1.0 \xb1 0.5 \\u2013 \\u03b3\n"


def test_a_quiet_run_says_nothing_and_still_warns(capsys):
    with terminal.silenced():
        terminal.say("a")
        terminal.warn("b")
    terminal.say("c")
    assert capsys.readouterr() == ("c\n", "b\n")


def train(run_dir, shell="", **how):
    """The command on a tiny run, its streams as the shell says."""
    argv = [
        "experiments/train.py",
        "--run-dir",
        run_dir,
        "--total-steps",
        "256",
        "--algo",
        "ppo",
        "--episodes",
        "1",
        *TINY,
    ]
    script = f'exec "$0" "$@" {shell}'
    return subprocess.Popen(["bash", "-c", script, sys.executable, *map(str, argv)], cwd=ROOT, **how)  # fmt: skip


def assert_it_is_whole(process, run_dir):
    assert process.wait(300) == 0
    assert (run_dir / "evaluation.json").exists()


OLD = {**os.environ, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}


@pytest.mark.parametrize(
    ("shell", "environment"),
    [
        (">/dev/full 2>/dev/full", {}),
        (">&- 2>&- <&-", {}),
        (">/dev/null", {"PYTHONIOENCODING": "ascii"}),
    ],
)
def test_a_run_ends_well_whatever_becomes_of_its_output(shell, environment, tmp_path):
    assert_it_is_whole(train(tmp_path / "run", shell, env={**OLD, **environment}), tmp_path / "run")
    for name in ("metrics.jsonl", "evaluations.jsonl"):  # nothing that was printed went into a file
        assert all(
            line.startswith(b'{"') for line in (tmp_path / "run" / name).read_bytes().splitlines()
        )


def test_a_reader_that_ends_after_the_first_line_ends_no_run(tmp_path):
    process = train(tmp_path / "run", stdout=subprocess.PIPE)
    assert b"hopper-v4 ppo" in process.stdout.readline()
    process.stdout.close()
    assert_it_is_whole(process, tmp_path / "run")


@pytest.mark.parametrize("hung_up", [False, True])
def test_a_live_bar_ends_no_run_on_an_old_terminal_or_one_that_is_gone(hung_up, tmp_path):
    master, slave = pty.openpty()
    process = train(
        tmp_path / "run",
        stdout=slave,
        stderr=slave,
        env={**OLD, "PYTHONIOENCODING": "ascii", "TERM": "xterm"},
    )
    os.close(slave)
    shown = [os.read(master, 1000)]
    if hung_up:
        os.close(master)
    else:
        reader = threading.Thread(target=_read_all, args=(master, shown))
        reader.start()
    assert_it_is_whole(process, tmp_path / "run")
    if not hung_up:
        reader.join()
        os.close(master)
        assert b"Traceback" not in b"".join(shown)
        assert b"256 of 256 steps" in b"".join(shown)


def _read_all(master, shown):
    try:
        while True:
            shown.append(os.read(master, 1000))
    except OSError:  # how Linux says that a terminal has nobody left
        return
