"""Atomic files and JSON."""

import json
import os
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from dgae_jax.run import files


def test_file_and_directory_are_synced(tmp_path, monkeypatch):
    order, sync, rename = [], os.fsync, Path.replace

    def fsync(descriptor):
        order.append(str(Path(f"/proc/self/fd/{descriptor}").readlink()))
        sync(descriptor)

    def replace(part, to):
        order.append("rename")
        return rename(part, to)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", replace)
    files.replace(tmp_path / "a", b"x")
    assert order == [str(tmp_path / f"a.{os.getpid()}.part"), "rename", str(tmp_path)]


@pytest.mark.parametrize(("owner", "step"), [(os, "fsync"), (Path, "replace")])
def test_failed_write_leaves_old_content(owner, step, tmp_path, monkeypatch):
    files.replace(tmp_path / "a", b"before")
    fail = Mock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr(owner, step, fail)
    with pytest.raises(OSError, match="No space left") as caught:
        files.replace(tmp_path / "a", b"after")
    assert caught.value.filename == str(tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_nonfinite_numbers_are_null_in_json(tmp_path):
    nan, inf = float("nan"), float("inf")
    data = {"a": nan, "b": [1.5, inf, {"c": (-inf, np.float64("nan"))}], "d": "NaN"}
    files.write_json(tmp_path / "a.json", data)
    files.append_rows(tmp_path / "a.jsonl", [data])
    for name in ("a.json", "a.jsonl"):
        found = json.loads((tmp_path / name).read_text())
        assert found == {"a": None, "b": [1.5, None, {"c": [None, None]}], "d": "NaN"}
