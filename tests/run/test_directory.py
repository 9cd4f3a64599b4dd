"""The run directory: created, locked, refused; its configuration and manifest."""

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
from functools import partial
from unittest.mock import Mock

import jax
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.serial import to_dict
from dgae_jax.run import directory
from dgae_jax.run.directory import InUseError
from dgae_jax.run.options import RunOptions
from tests.helpers import ROOT
from tests.runs import SMALL, create, exit_code, small


def test_new_directory_holds_config_and_manifest(tmp_path):
    create(tmp_path / "a" / "b")
    assert directory.read_config(tmp_path / "a" / "b") == SMALL
    manifest = json.loads((tmp_path / "a" / "b" / "manifest.json").read_text())
    assert manifest["versions"]["jax"] == jax.__version__
    assert {"command", "git_revision", "device", "python", "started"} <= set(manifest)


def test_used_or_unwritable_directory_is_refused(tmp_path, monkeypatch):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(ConfigError, match=r"run_dir .*: must be a new or empty directory"):
        create(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]
    with pytest.raises(ConfigError, match="must be a directory that can be written"):
        create(tmp_path / "note.txt" / "below")
    full = OSError(28, "No space left on device")
    monkeypatch.setattr(os, "fsync", Mock(side_effect=full))
    with pytest.raises(ConfigError, match=r"that can be written \(No space left"):
        create(tmp_path / "run")


BAD_ENV = json.dumps(to_dict(dataclasses.replace(SMALL, env="hoper")))


@pytest.mark.parametrize(
    ("text", "why"),
    [("", ""), ("[]", ""), ('{"env": "hopper"}', ""), (BAD_ENV, "env hoper: must be one of")],
)
def test_bad_config_file_is_refused(text, why, tmp_path):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"config\.json: {why}"):
        directory.read_config(tmp_path)


def test_directory_in_use_is_refused_and_left_alone(run_dir):
    in_use = pytest.raises(InUseError, match="another process is training there")
    with directory.locked(run_dir), in_use:
        exit_code(small(), resume=run_dir)
    with directory.locked(run_dir):
        pass


def test_of_two_that_create_at_once_one_is_refused(tmp_path):
    with directory.created(tmp_path / "run", SMALL, RunOptions()):
        with pytest.raises(ConfigError, match="must be a new or empty directory"):
            create(tmp_path / "run")
        (tmp_path / "run" / "config.json").unlink()  # as before the first has written it
        with pytest.raises(InUseError, match="another process is training there"):
            create(tmp_path / "run")


def test_directory_that_cannot_be_locked_is_refused(run_dir):
    (run_dir / "metrics.jsonl").unlink()
    (run_dir / "metrics.jsonl").mkdir()
    with pytest.raises(ConfigError, match="must be a directory that can be written"):
        exit_code(small(), resume=run_dir)


@pytest.mark.parametrize("make", [lambda path: path.symlink_to("outside"), os.mkfifo])
@pytest.mark.parametrize("name", ["curve.png", "checkpoints/steps_000000000256.msgpack"])
def test_link_or_pipe_in_run_directory_is_refused(name, make, run_dir):
    (run_dir / name).rename((run_dir / name).with_name("outside"))
    make(run_dir / name)
    before = sorted((p, p.lstat().st_mtime_ns) for p in run_dir.rglob("*"))
    with pytest.raises(ConfigError, match=rf"run/{name}: must be .* not a link or pipe"):
        exit_code(small(), resume=run_dir)
    assert sorted((p, p.lstat().st_mtime_ns) for p in run_dir.rglob("*")) == before


class Killed(BaseException):
    pass


@pytest.mark.parametrize("step", range(12))
def test_killed_creation_can_start_or_resume(step, tmp_path, monkeypatch):
    left, run_dir = iter(range(step, -1, -1)), tmp_path / "run"

    def dying(*args, honest, **more):
        if next(left, 0) == 0:
            raise Killed
        return honest(*args, **more)

    with monkeypatch.context() as patch, contextlib.suppress(Killed):
        for name in ("fsync", "mkdir", "rename", "replace", "unlink"):
            patch.setattr(os, name, partial(dying, honest=getattr(os, name)))
        create(run_dir)
    if not directory.has_begun(run_dir):
        create(run_dir)
    assert directory.read_config(run_dir) == SMALL
    assert {"manifest.json", "checkpoints"} <= {path.name for path in run_dir.iterdir()}


def test_reading_a_directory_does_not_import_jax(run_dir):
    program = (
        "import sys; from pathlib import Path; from dgae_jax.run import directory;"
        f"directory.read_config(Path({str(run_dir)!r})); directory.saved_options(Path('.'));"
        "assert not {'jax', 'matplotlib', 'rich', 'mujoco'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)
