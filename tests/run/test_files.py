"""Files that are whole or not there."""

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from dgae_jax.run import files


def test_a_file_and_then_the_directory_that_names_it_are_synced(tmp_path, monkeypatch):
    order, sync, rename = [], os.fsync, Path.replace
    monkeypatch.setattr(
        os,
        "fsync",
        lambda fd: order.append(str(Path(f"/proc/self/fd/{fd}").readlink())) or sync(fd),
    )
    monkeypatch.setattr(
        Path, "replace", lambda part, to: order.append("rename") or rename(part, to)
    )
    files.replace(tmp_path / "a", b"x")
    assert order == [str(tmp_path / "a.part"), "rename", str(tmp_path)]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_file_that_cannot_be_finished_leaves_what_was_there(step, tmp_path, monkeypatch):
    files.replace(tmp_path / "a", b"before")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os if step == "fsync" else Path, step, fail)
    with pytest.raises(OSError, match="No space left") as caught:
        files.replace(tmp_path / "a", b"after")
    assert caught.value.filename == str(tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_numbers_that_are_not_finite_are_null_in_json_however_deep(tmp_path):
    data = {
        "a": float("nan"),
        "b": [1.5, float("inf"), {"c": (-float("inf"), np.float64("nan"))}],
        "d": "NaN",
        "e": 1,
    }
    files.write_json(tmp_path / "a.json", data)
    files.append_rows(tmp_path / "a.jsonl", [data])
    for name in ("a.json", "a.jsonl"):
        assert json.loads((tmp_path / name).read_text()) == {
            "a": None,
            "b": [1.5, None, {"c": [None, None]}],
            "d": "NaN",
            "e": 1,
        }


def test_of_several_that_write_in_a_directory_each_has_its_turn(tmp_path):
    inside, most = [], []

    def work(_):
        with files.turn(tmp_path):
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.01)
            inside.pop()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(16)))
    assert most == [1] * 16
