"""`dgae export` as a user meets it."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from dgae_jax.cli import export
from dgae_jax.run import checkpoint
from dgae_jax.run.directory import read_config
from dgae_jax.run.training import train_command
from tests.helpers import ROOT
from tests.runs import QUIET, last, small


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / "ppo"
    train_command(small("ppo", seeds=2), dataclasses.replace(QUIET, run_dir=run_dir))
    return run_dir


@pytest.fixture
def run_dir(trained, tmp_path):
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture
def run(monkeypatch, capsys):
    def run(*argv):
        monkeypatch.setattr(sys, "argv", ["dgae export", *map(str, argv)])
        try:
            code = export.main()
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return run


def test_each_format_is_a_directory_in_the_run_directory(run_dir):
    command = [
        sys.executable,
        "experiments/export.py",
        str(run_dir),
        "--to",
        "npz",
        "onnx",
        "gymnasium",
        "--index",
        "1",
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == (
        f"written to {run_dir / 'export' / 'npz'}: policy.npz, policy.py, README.md\n"
        f"written to {run_dir / 'export' / 'onnx'}: policy.onnx, README.md\n"
        f"written to {run_dir / 'export' / 'gymnasium'}: policy.npz, agent.py, README.md\n"
    )
    assert sorted(path.name for path in (run_dir / "export").rglob("*") if path.is_file()) == [
        "README.md", "README.md", "README.md", "agent.py", "policy.npz", "policy.npz", "policy.onnx", "policy.py",
    ]  # fmt: skip


def test_a_policys_file_is_exported_beside_it_and_again_over_it(run_dir, run, tmp_path):
    config = read_config(run_dir)
    file = tmp_path / "policies" / "hopper.msgpack"
    file.parent.mkdir()
    found = checkpoint.load_networks(run_dir, config, "latest")
    checkpoint.save_networks(file, config, found, checkpoint.reward_std(found.path, config))
    for _ in range(2):
        code, out, err = run(file, "--to", "npz", "npz")
        where = tmp_path / "policies" / "hopper-export" / "npz"
        assert (code, out, err) == (
            0,
            f"written to {where}: policy.npz, policy.py, README.md\n",
            "",
        )
    assert sorted(path.name for path in where.iterdir()) == ["README.md", "policy.npz", "policy.py"]
    code, _, err = run(file, "--to", "npz", "--checkpoint", "best")
    assert (code, err) == (2, f"error: --checkpoint best: must be latest: {file} is a single one\n")


def test_each_seed_and_each_checkpoint_has_its_own_weights(run_dir, run, tmp_path):
    def weights(*argv):
        assert run(run_dir, "--to", "npz", "--out", tmp_path / "new" / "out", *argv)[0] == 0
        with np.load(tmp_path / "new" / "out" / "npz" / "policy.npz") as arrays:
            return arrays["policy_weight_0"]

    first, second, default = (weights(*argv) for argv in (["--index", 0], ["--index", 1], []))
    np.testing.assert_array_equal(first, default)
    assert not np.array_equal(first, second)
    last(run_dir).unlink()
    assert not np.array_equal(weights(), first)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (
            ["nowhere", "--to", "npz"],
            r"nowhere: must be a run directory; there is nothing of that name",
        ),
        (["RUN", "--to", "tflite"], r"--to tflite: must be one of npz, onnx, gymnasium"),
        (["RUN"], r"--to"),
        (["RUN", "--to"], r"--to"),
        (["RUN", "--to", "npz", "--checkpoint", "last"], r"--checkpoint last: must be one of"),
        (
            ["RUN", "--to", "npz", "--index", "2"],
            r"--index 2: must be a whole number from 0 to 1, the index of a seed in RUN",
        ),
        (
            ["RUN", "--to", "npz", "--index", "-1"],
            r"--index -1: must be a whole number from 0 to 1, the index of a seed in RUN",
        ),
        (
            ["RUN", "--to", "npz", "--out", "/dev/null/x"],
            r"--out /dev/null/x: must be a directory that can be written",
        ),
        (
            ["RUN", "--to", "npz", "--out", "RUN/config.json"],
            r"--out RUN/config\.json: must be a directory that can be written",
        ),
        (
            ["RUN", "--to", "npz", "--out", "x" * 300],
            r"--out x+: must be a directory that can be written",
        ),
    ],
)
def test_bad_input_is_refused_in_one_line_before_anything_is_written(
    argv, message, run_dir, run, monkeypatch, tmp_path
):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    before = {path: path.stat().st_mtime_ns for path in run_dir.rglob("*")}
    code, out, err = run(*(word.replace("RUN", str(run_dir)) for word in argv))
    assert (code, out) == (2, "")
    assert re.fullmatch(rf"error: .*{message}.*\n", err.replace(str(run_dir), "RUN"))
    assert {path: path.stat().st_mtime_ns for path in run_dir.rglob("*")} == before
    assert list((tmp_path / "here").iterdir()) == []


def test_a_place_that_turns_out_not_to_be_writable_is_refused_in_one_line(run_dir, run, tmp_path):
    (tmp_path / "out" / "npz" / "policy.npz").mkdir(parents=True)
    code, out, err = run(run_dir, "--to", "npz", "--out", tmp_path / "out")
    assert (code, out) == (2, "")
    assert (
        err
        == f"error: --out {tmp_path / 'out'}: must be a directory that can be written (Is a directory)\n"
    )


def test_without_onnx_its_extra_is_named_and_the_other_formats_go_on(run_dir, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    code, out, err = run(run_dir, "--to", "npz", "onnx")
    assert (code, out) == (2, "")
    assert (
        err
        == 'error: onnx is not installed, which makes the model: pip install "dgae_jax[export]", or leave out --to onnx\n'
    )
    assert not (run_dir / "export").exists()
    assert run(run_dir, "--to", "npz", "gymnasium")[0] == 0


def test_a_task_that_gymnasium_does_not_have_gets_no_agent(run_dir, run):
    config = json.loads((run_dir / "config.json").read_text())
    config |= {"env": "brax:ant", "env_version": None, "physics": "mjx"}
    (run_dir / "config.json").write_text(json.dumps(config))
    code, _, err = run(run_dir, "--to", "gymnasium")
    assert (code, err) == (
        2,
        "error: --to gymnasium: must be left out with brax:ant, which Gymnasium does not play\n",
    )


def test_a_mistake_is_refused_before_jax_and_mujoco_are_imported(run_dir):
    program = """
import sys
from dgae_jax.cli.export import main
sys.argv = ["export", sys.argv[1], "--to", "onnx", "--index", "9"]
try:
    main()
except SystemExit as stop:
    print(stop.code, [name for name in ("jax", "mujoco", "brax", "flax", "gymnasium", "onnx") if name in sys.modules])
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(run_dir)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.stdout == "2 []\n"
    assert done.stderr.startswith("error: --index 9: must be")
