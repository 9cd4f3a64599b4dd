"""The commands as a user meets them."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from dgae_jax.cli import parse
from dgae_jax.cli.train import parsed
from dgae_jax.run import directory, metrics
from tests.helpers import ROOT, TINY


def test_training_writes_a_run_directory_within_its_budget(trained):
    run_dir, lines, errors = trained
    names = "config.json manifest.json metrics.jsonl evaluations.jsonl evaluation.json"
    assert {p.name for p in run_dir.iterdir()} == {*names.split(), "checkpoints", "curve.png"}
    assert (errors, "\x1b" in "".join(lines)) == ("", False)
    assert lines[0].endswith("15 iterations × 64 samples × 1 seed")
    rows = metrics.read(run_dir / "metrics.jsonl")
    assert [row["steps"] for row in rows] == list(range(64, 961, 64))
    result = json.loads((run_dir / "evaluation.json").read_text())
    assert f"return {result['return_mean']:,.1f} ± {result['return_std']:,.1f}" in lines[-1]


def test_checkpoints_are_evaluated_and_the_best_is_kept(trained, dgae, tmp_path):
    run_dir, _, _ = trained
    evaluations = metrics.read(run_dir / "evaluations.jsonl")
    assert [row["steps"] for row in evaluations] == [256, 512, 768, 960]
    best = max(evaluations[:-1], key=lambda row: (row["return_mean"], row["steps"]))["steps"]
    names = [p.name for p in sorted((run_dir / "checkpoints").iterdir())]
    assert names == [f"steps_{steps:012d}.msgpack" for steps in sorted({best, 512, 768, 960})]
    out = tmp_path / "best.json"
    dgae("evaluate", run_dir, "--checkpoint", "best", "--episodes", 3, "--out", out)
    expected = max(row["return_mean"] for row in evaluations)
    assert json.loads(out.read_text())["return_mean"] == pytest.approx(expected)


@pytest.mark.parametrize("engine", ["gymnasium", "native"])
def test_evaluate_writes_json(engine, trained, dgae):
    code, out, _ = dgae("evaluate", trained[0], "--engine", engine, "--episodes", 3)
    result = json.loads((trained[0] / f"evaluation-{engine}.json").read_text())
    assert (code, result["engine"], len(result["returns"])) == (0, engine, 3)
    assert f"return {result['return_mean']:,.1f} ± {result['return_std']:,.1f}" in out
    if engine == "gymnasium":  # the seed of the final evaluation
        final = json.loads((trained[0] / "evaluation.json").read_text())
        assert result["returns"] == final["returns"]


def test_an_output_that_is_no_file_is_left_alone(trained, dgae, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for name in ("pipe", "link", ".", "no/file"):
        code, _, err = dgae("evaluate", trained[0], "--out", tmp_path / name)
        assert code == 2
        assert "must be a file, new or not, in a directory that exists" in err
    assert (tmp_path / "pipe").is_fifo()


def test_a_resumed_run_starts_from_its_own_flags(trained):
    config, options = parsed(["--resume", str(trained[0]), "--episodes", "5"])
    assert config == directory.read_config(trained[0])
    assert (options.checkpoint_every, options.episodes, options.keep_checkpoints) == (300, 5, 3)


def test_an_interrupt_ends_the_process_at_once(monkeypatch, capsys):
    def interrupt(argv):
        raise KeyboardInterrupt

    codes = []
    monkeypatch.setattr(os, "_exit", codes.append)
    parse.Command(None, interrupt, None)()
    assert (codes, capsys.readouterr().err) == ([130], "stopped by SIGINT\n")


@pytest.mark.parametrize(("kind", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_saves_a_checkpoint_and_ends_with_its_code(kind, code, tmp_path):
    argv = ["--total-steps", "1e8", "--run-dir", str(tmp_path / "run"), *TINY]
    process = subprocess.Popen(
        [sys.executable, "-m", "dgae_jax", "train", *argv],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    lines = tmp_path / "run" / "metrics.jsonl"
    deadline = time.monotonic() + 120
    while not (lines.exists() and lines.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.2)
    process.send_signal(kind)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == code
    assert f"stopped by {kind.name}; continue with --resume" in out
    steps = metrics.read(lines)[-1]["steps"]
    assert (tmp_path / "run" / "checkpoints" / f"steps_{steps:012d}.msgpack").exists()
