"""A signal where nothing is lost by stopping."""

import importlib
import os
import signal

import pytest

from dgae_jax.run.runtime import Signals, Stopped


def test_a_signal_in_the_middle_of_an_import_leaves_it_whole_and_stops_the_work_at_its_next_word(
    monkeypatch, tmp_path, capfd
):
    (tmp_path / "signalled.py").write_text(
        "import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\nwhole = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    told = []
    with Signals() as signals, signals.may_stop(told.append) as watch:
        watch("before")
        assert importlib.import_module("signalled").whole
        with pytest.raises(Stopped):
            watch("after")
    assert (told, signals.name, signals.exit_code) == (["before"], "SIGTERM", 143)
    assert capfd.readouterr().err == ""


def test_a_signal_where_something_would_be_lost_is_noted_and_the_next_work_that_may_stop_does(
    capfd,
):
    with Signals() as signals:
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(Stopped), signals.may_stop():
            pytest.fail("nothing is begun")
    assert (
        capfd.readouterr().err
        == "SIGTERM: finishing what is running, then saving; a second signal ends it at once\n"
    )
