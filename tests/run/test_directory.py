"""The directory of a run."""

import contextlib
import dataclasses
import json
import os
import shutil
import subprocess
import sys

import jax
import pytest

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.serial import to_dict
from dgae_jax.run import directory, files
from dgae_jax.run.options import RunOptions
from dgae_jax.run.training import train_command
from tests.helpers import ROOT
from tests.runs import QUIET, SMALL, small


def test_a_run_directory_says_what_the_run_is(tmp_path):
    directory.create(tmp_path / "a" / "b", SMALL, RunOptions())
    assert directory.read_config(tmp_path / "a" / "b") == SMALL
    manifest = json.loads((tmp_path / "a" / "b" / "manifest.json").read_text())
    assert manifest["versions"]["jax"] == jax.__version__
    assert {"command", "git_revision", "device", "python", "started"} <= set(manifest)


def test_a_used_or_unwritable_run_directory_is_refused_and_left_alone(tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(ConfigError, match=r"run_dir .*: must be a new or empty directory"):
        directory.create(tmp_path, SMALL, RunOptions())
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]
    with pytest.raises(ConfigError, match=r"run_dir .*: must be a directory that can be written"):
        directory.create(tmp_path / "note.txt" / "below", SMALL, RunOptions())
    with pytest.raises(ConfigError, match=r"run_dir .*: must be a new or empty directory"):
        directory.create(tmp_path / "note.txt", SMALL, RunOptions())


def test_an_empty_run_directory_is_welcome(tmp_path):
    directory.create(tmp_path, SMALL, RunOptions())
    assert (tmp_path / "checkpoints").is_dir()


@pytest.mark.parametrize("text", ["", "[]", "{", '{"env": "hopper"}'])
def test_a_config_file_that_is_none_is_refused(text, tmp_path):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ConfigError, match=r"config\.json"):
        directory.read_config(tmp_path)


def test_a_config_file_with_an_impossible_value_is_refused(tmp_path):
    files.write_json(tmp_path / "config.json", to_dict(dataclasses.replace(SMALL, env="hoper")))
    with pytest.raises(ConfigError, match=r"config\.json: env hoper: must be one of"):
        directory.read_config(tmp_path)


def test_a_directory_in_use_is_refused_and_left_alone_also_while_its_configuration_is_rewritten(
    run_dir,
):
    with directory.locked(run_dir):
        directory.write_config(run_dir, directory.read_config(run_dir))
        with pytest.raises(ConfigError, match="another process is training there"):
            train_command(small(), dataclasses.replace(QUIET, resume=run_dir))
    with directory.locked(run_dir):
        pass


@contextlib.contextmanager
def without_rights(directory):
    """As somebody who may read the directory at most, also where the tests are run by root."""
    user = os.geteuid()
    directory.chmod(0o500)
    os.seteuid(user or 65534)
    try:
        yield
    finally:
        os.seteuid(user)
        directory.chmod(0o700)


def test_a_directory_that_cannot_be_written_is_one_clear_line(run_dir):
    with (
        without_rights(run_dir),
        pytest.raises(
            ConfigError, match=r"must be a directory that can be written.*Permission denied"
        ),
    ):
        train_command(small(), dataclasses.replace(QUIET, run_dir=run_dir / "below"))
    with without_rights(run_dir), pytest.raises(ConfigError, match="Permission denied"):
        train_command(small(), dataclasses.replace(QUIET, resume=run_dir))


PARTS = [
    "config.json",
    "metrics.jsonl",
    "evaluations.jsonl",
    "checkpoints",
    "checkpoints/steps_000000000256.msgpack",
]


@pytest.mark.parametrize("name", PARTS)
def test_a_run_directory_with_a_link_in_it_is_refused_and_nothing_is_touched(
    name, run_dir, tmp_path
):
    (run_dir / name).rename(tmp_path / "outside")
    (run_dir / name).symlink_to(tmp_path / "outside")
    before = sorted((p, p.lstat().st_mtime_ns) for p in tmp_path.rglob("*"))
    with pytest.raises(
        ConfigError,
        match=rf"run/{name}: must be a (file|directory) in the run directory itself, not a link",
    ):
        train_command(directory.read_config(run_dir), dataclasses.replace(QUIET, resume=run_dir))
    assert sorted((p, p.lstat().st_mtime_ns) for p in tmp_path.rglob("*")) == before


def test_a_pipe_in_place_of_a_file_is_refused_and_does_not_hang(run_dir):
    (run_dir / "config.json").unlink()
    os.mkfifo(run_dir / "config.json")
    with pytest.raises(ConfigError, match="not a link or anything else"):
        directory.read_config(run_dir)


@pytest.mark.parametrize(
    "name", ["curve.png", "curve.png.part", "evaluation.json", "manifest.json.part"]
)
def test_links_where_whole_files_are_written_are_replaced_and_not_followed(name, run_dir, tmp_path):
    (tmp_path / "outside").write_text("mine")
    (run_dir / name).unlink(missing_ok=True)
    (run_dir / name).symlink_to(tmp_path / "outside")
    assert train_command(small(), dataclasses.replace(QUIET, resume=run_dir)) == 0
    assert (tmp_path / "outside").read_text() == "mine"
    assert not (run_dir / name).is_symlink()


def test_the_public_way_to_a_preset_and_back_through_a_file_is_the_same_configuration(tmp_path):
    config = dg.preset("paper", "dtrpo", "ant")
    files.write_json(tmp_path / "config.json", to_dict(config))
    assert directory.read_config_file(tmp_path / "config.json") == config


KILLED_ANYWHERE = """
import os, sys
from pathlib import Path
from dgae_jax.run import directory, manifest
from dgae_jax.run.options import RunOptions
from tests.helpers import ROOT
from tests.runs import SMALL

manifest._git_revision = lambda: None
parent = Path(sys.argv[1])

def killed(run_dir, step):
    "Create it in a process that dies before its operation number `step` on the file system; whether it did."
    child = os.fork()
    if child == 0:
        left = iter(range(step, -1, -1))
        for name in ("fsync", "mkdir", "rename", "replace", "chmod", "unlink"):
            def dying(*args, honest=getattr(os, name), **more):
                if next(left) == 0:
                    os._exit(9)
                return honest(*args, **more)
            setattr(os, name, dying)
        try:
            directory.create(run_dir, SMALL, RunOptions())
        except StopIteration:
            os._exit(9)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9

for exists in (False, True):
    for step in range(99):
        run_dir = parent / f"{exists}-{step}"
        if exists:
            run_dir.mkdir()
        died = killed(run_dir, step)
        if directory.has_begun(run_dir):
            assert directory.read_config(run_dir) == SMALL
            assert (run_dir / "manifest.json").exists() and (run_dir / "checkpoints").is_dir()
        else:
            assert died
            directory.create(run_dir, SMALL, RunOptions())
        assert {p.name for p in run_dir.iterdir()} - {"config.json.part"} == {"config.json", "manifest.json", "checkpoints"}
        if not died:
            break
    print(exists, step)
for left in parent.iterdir():
    assert not left.name.startswith("."), left
"""


def test_a_process_killed_at_any_step_leaves_a_directory_that_can_be_started_or_resumed(tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", KILLED_ANYWHERE, tmp_path],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    beside, inside = (int(line.split()[1]) for line in done.stdout.splitlines())
    assert min(beside, inside) >= 6  # steps at which it was killed


@pytest.mark.parametrize("exists", [False, True])
def test_a_disk_that_is_full_at_once_is_refused_and_leaves_nothing_that_is_in_the_way(
    exists, tmp_path, monkeypatch
):
    run_dir = tmp_path / "run"
    if exists:
        run_dir.mkdir()

    def full(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(
            ConfigError, match=r"must be a directory that can be written \(No space left"
        ):
            directory.create(run_dir, SMALL, RunOptions())
    assert [p.name for p in tmp_path.iterdir()] == (["run"] if exists else [])
    directory.create(run_dir, SMALL, RunOptions())
    assert directory.read_config(run_dir) == SMALL


def test_the_attempt_of_a_process_that_is_alive_is_left_alone_and_a_dead_ones_is_removed(tmp_path):
    alive, dead, other = (
        tmp_path / f".{name}.part" for name in ("run.alive", "run.dead", "runs.x")
    )
    for each in (alive, dead, other):
        (each / "checkpoints").mkdir(parents=True)
    with directory._held(alive):
        directory.create(tmp_path / "run", SMALL, RunOptions())
        assert sorted(p.name for p in tmp_path.iterdir()) == [
            ".run.alive.part",
            ".runs.x.part",
            "run",
        ]


def test_of_two_that_begin_at_once_one_is_refused(tmp_path, monkeypatch):
    def quicker(path, config, options, honest=directory._fill):
        honest(path, config, options)
        if path.name != "run":
            shutil.copytree(path, tmp_path / "run")

    monkeypatch.setattr(directory, "_fill", quicker)
    with pytest.raises(ConfigError, match=r"run_dir .*run: must be a new or empty directory"):
        directory.create(tmp_path / "run", SMALL, RunOptions())
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
