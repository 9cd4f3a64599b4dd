"""The run directory: created, locked, refused; its configuration and manifest."""

import contextlib
import dataclasses
import json
import os
import subprocess
import sys

import jax
import pytest

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.configs.serial import to_dict
from dgae_jax.run import directory, files
from dgae_jax.run.directory import InUseError
from dgae_jax.run.options import RunOptions
from dgae_jax.run.training import train_command
from tests.helpers import ROOT
from tests.runs import QUIET, SMALL, create, small


def test_new_directory_holds_config_and_manifest(tmp_path):
    create(tmp_path / "a" / "b")
    assert directory.read_config(tmp_path / "a" / "b") == SMALL
    manifest = json.loads((tmp_path / "a" / "b" / "manifest.json").read_text())
    assert manifest["versions"]["jax"] == jax.__version__
    assert {"command", "git_revision", "device", "python", "started"} <= set(manifest)


def test_used_or_unwritable_directory_is_refused(tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(ConfigError, match=r"run_dir .*: must be a new or empty directory"):
        create(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]
    for path in (tmp_path / "note.txt" / "below", tmp_path / "note.txt"):
        with pytest.raises(ConfigError, match=r"run_dir .*: must be a directory that can be"):
            create(path)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"env": "hopper"}'])
def test_bad_config_file_is_refused(text, tmp_path):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ConfigError, match=r"config\.json"):
        directory.read_config(tmp_path)


def test_impossible_value_in_config_file_is_refused(tmp_path):
    files.write_json(tmp_path / "config.json", to_dict(dataclasses.replace(SMALL, env="hoper")))
    with pytest.raises(ConfigError, match=r"config\.json: env hoper: must be one of"):
        directory.read_config(tmp_path)


def test_preset_comes_back_from_its_file(tmp_path):
    config = dg.preset("paper", "dtrpo", "ant")
    files.write_json(tmp_path / "config.json", to_dict(config))
    assert directory.read_config_file(tmp_path / "config.json") == resolve(config)


def test_directory_in_use_is_refused_and_left_alone(run_dir):
    with directory.locked(run_dir):
        directory.write_config(run_dir, directory.read_config(run_dir))
        with pytest.raises(InUseError, match="another process is training there"):
            train_command(small(), dataclasses.replace(QUIET, resume=run_dir))
    with directory.locked(run_dir):
        pass


def test_of_two_that_create_at_once_one_is_refused(tmp_path):
    with directory.created(tmp_path / "run", SMALL, RunOptions()):
        with pytest.raises(ConfigError, match="must be a new or empty directory"):
            create(tmp_path / "run")
        (tmp_path / "run" / "config.json").unlink()  # as before the first has written it
        with pytest.raises(InUseError, match="another process is training there"):
            create(tmp_path / "run")


@contextlib.contextmanager
def without_rights(directory):
    """Become a user who may at most read the directory, also where the tests run as root."""
    user = os.geteuid()
    directory.chmod(0o500)
    os.seteuid(user or 65534)
    try:
        yield
    finally:
        os.seteuid(user)
        directory.chmod(0o700)


@pytest.mark.parametrize("option", ["run_dir", "resume"])
def test_unwritable_directory_is_refused(option, run_dir):
    path = run_dir / "below" if option == "run_dir" else run_dir
    refused = pytest.raises(ConfigError, match="Permission denied")
    with without_rights(run_dir), refused:
        train_command(small(), dataclasses.replace(QUIET, **{option: path}))


@pytest.mark.parametrize(
    "name",
    ["config.json", "metrics.jsonl", "checkpoints", "checkpoints/steps_000000000256.msgpack"],
)
def test_link_in_run_directory_is_refused(name, run_dir, tmp_path):
    (run_dir / name).rename(tmp_path / "outside")
    (run_dir / name).symlink_to(tmp_path / "outside")
    before = sorted((p, p.lstat().st_mtime_ns) for p in tmp_path.rglob("*"))
    with pytest.raises(ConfigError, match=rf"run/{name}: must be a (file|directory) in the run"):
        train_command(small(), dataclasses.replace(QUIET, resume=run_dir))
    assert sorted((p, p.lstat().st_mtime_ns) for p in tmp_path.rglob("*")) == before


def test_pipe_in_place_of_file_does_not_hang(run_dir):
    (run_dir / "config.json").unlink()
    os.mkfifo(run_dir / "config.json")
    with pytest.raises(ConfigError, match="must be a file in the run directory"):
        directory.read_config(run_dir)


@pytest.mark.parametrize("name", ["curve.png", "curve.png.part", "manifest.json.part"])
def test_link_in_place_of_written_file_is_not_followed(name, run_dir, tmp_path):
    (tmp_path / "outside").write_text("mine")
    (run_dir / name).unlink(missing_ok=True)
    (run_dir / name).symlink_to(tmp_path / "outside")
    assert train_command(small(), dataclasses.replace(QUIET, resume=run_dir)) == 0
    assert (tmp_path / "outside").read_text() == "mine"
    assert not (run_dir / name).is_symlink()


def test_full_disk_is_refused_and_leaves_an_empty_directory(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(ConfigError, match=r"that can be written \(No space left"):
            create(tmp_path / "run")
    create(tmp_path / "run")
    assert directory.read_config(tmp_path / "run") == SMALL


KILLED_ANYWHERE = """
import os, sys
from pathlib import Path
from dgae_jax.run import directory
from tests.runs import SMALL, create

directory._git_revision = lambda: None
parent = Path(sys.argv[1])

def killed(run_dir, step):
    "Create it in a process that dies before its file operation number `step`; return whether."
    child = os.fork()
    if child == 0:
        left = iter(range(step, -1, -1))
        for name in ("fsync", "mkdir", "rename", "replace", "unlink"):
            def dying(*args, honest=getattr(os, name), **more):
                if next(left) == 0:
                    os._exit(9)
                return honest(*args, **more)
            setattr(os, name, dying)
        try:
            create(run_dir)
        except StopIteration:
            os._exit(9)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9

for step in range(99):
    run_dir = parent / str(step)
    died = killed(run_dir, step)
    if directory.has_begun(run_dir):
        assert directory.read_config(run_dir) == SMALL
        assert (run_dir / "manifest.json").exists() and (run_dir / "checkpoints").is_dir()
    else:
        assert died
        create(run_dir)
    if not died:
        break
print(step)
"""


def test_killed_creation_can_start_or_resume(tmp_path):
    argv = [sys.executable, "-W", "ignore", "-c", KILLED_ANYWHERE, tmp_path]
    done = subprocess.run(argv, cwd=ROOT, capture_output=True, text=True)
    assert done.stderr == ""
    assert int(done.stdout) >= 6  # steps at which it was killed


def test_reading_a_directory_does_not_import_jax(run_dir):
    program = (
        "import sys; from pathlib import Path; from dgae_jax.run import directory;"
        f"directory.read_config(Path({str(run_dir)!r})); directory.saved_options(Path('.'));"
        "assert not {'jax', 'matplotlib', 'rich', 'mujoco'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)
