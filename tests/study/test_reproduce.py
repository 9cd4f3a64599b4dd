"""A study as a user meets it: real processes, real runs."""

import errno
import json
import os
import shutil
import signal
import sys
import time

import numpy as np
import pytest

import dgae_jax as dg
from dgae_jax.cli.reproduce import main
from dgae_jax.run import directory, files, metrics
from dgae_jax.run.evaluation import evaluate_run
from tests import studies
from tests.runs import last


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A study of four cells that was not disturbed, and what it said."""
    study = tmp_path_factory.mktemp("studies") / "whole"
    return study, studies.finish(studies.start(study))


@pytest.fixture
def study(whole, tmp_path):
    """A copy."""
    shutil.copytree(whole[0], tmp_path / "study")
    return tmp_path / "study"


def test_a_study_ends_with_a_row_per_cell_and_says_so(whole):
    study, (code, lines, errors) = whole
    assert (code, errors) == (0, "")
    assert lines[0] == f"{study}: 0 of 4 cells are done, 4 to train"
    assert sorted(line.split(":")[0] for line in lines[1:] if "return" in line) == sorted(
        studies.cells(study)
    )
    assert [row["cell"] for row in studies.rows(study)] == [
        "hopper-ppo-0",
        "hopper-dppo-0",
        "hopper-ppo-1",
        "hopper-dppo-1",
    ]


def test_a_row_is_what_the_run_directory_says(whole):
    study, _ = whole
    for row in metrics.read(study / "results.jsonl"):
        run_dir = study / "runs" / row["cell"]
        final, trained = (
            json.loads((run_dir / "evaluation.json").read_text()),
            metrics.read(run_dir / "metrics.jsonl"),
        )
        assert row["final"]["returns"] == final["returns"]
        assert row["config"] == json.loads((run_dir / "config.json").read_text())
        assert (row["steps"], row["total_steps"], row["seconds"]) == (
            640,
            640,
            trained[-1]["seconds"],
        )
        assert row["best"]["return_mean"] == max(row["evaluations"]["return_mean"])
        assert row["curve"]["steps"] == [each["steps"] for each in trained]
        assert row["command"].startswith("dgae reproduce ")


def test_the_policy_of_a_cell_gives_its_returns_again(whole):
    study, _ = whole
    for row in studies.rows(study):
        file = study / row["policy"]
        found = evaluate_run(file, directory.config_of(file), which="latest", episodes=2)
        assert found["returns"] == row["final"]["returns"]
        assert dg.load_policy(file)(np.zeros(11)).shape == (3,)
        assert file.stat().st_size < 20_000


def test_run_again_it_skips_what_is_done_and_writes_the_same(study):
    before = (study / "results.jsonl").read_bytes()
    code, lines, errors = studies.finish(studies.start(study))
    assert (code, lines, errors) == (0, [f"{study}: 4 of 4 cells are done"], "")
    assert (study / "results.jsonl").read_bytes() == before


def test_results_without_their_run_directories_are_kept_and_their_cells_are_done(study):
    before = (study / "results.jsonl").read_bytes()
    shutil.rmtree(study / "runs")
    code, lines, errors = studies.finish(studies.start(study))
    assert (code, lines, errors) == (0, [f"{study}: 4 of 4 cells are done"], "")
    assert (study / "results.jsonl").read_bytes() == before


def test_a_broken_cell_goes_on_from_its_checkpoint_and_a_failed_one_stops_no_other(whole, study):
    torn, lost = study / "runs/hopper-ppo-0", study / "runs/hopper-dppo-1"
    last(torn).unlink()
    (torn / "evaluation.json").unlink()
    shutil.rmtree(lost)
    lost.touch()  # a file where the directory should be
    code, lines, errors = studies.finish(studies.start(study))
    assert code == 1
    assert any(line.startswith("hopper-dppo-1: ended with exit code 2: error: ") for line in lines)
    assert errors.startswith("failed: hopper-dppo-1, see ")
    assert (
        "resuming from steps_000000000320.msgpack" in (study / "logs/hopper-ppo-0.log").read_text()
    )
    assert studies.rows(study) == studies.rows(whole[0])[:3]


def test_a_cell_that_was_begun_on_another_machine_goes_on_here_if_asked_to(study):
    torn = study / "runs/hopper-ppo-0"
    last(torn).unlink()
    (torn / "evaluation.json").unlink()
    manifest = json.loads((torn / "manifest.json").read_text())
    (torn / "manifest.json").write_text(json.dumps({**manifest, "cores": 99}))
    code, lines, _ = studies.finish(studies.start(study))
    assert code == 1
    assert any(
        "hopper-ppo-0: ended with exit code 2: error: resume" in line
        and "or with --inexact" in line
        for line in lines
    )
    code, _, errors = studies.finish(studies.start(study, "--inexact"))
    assert (code, errors) == (0, "")
    assert "warning: cores 1 (was 99)" in (study / "logs/hopper-ppo-0.log").read_text()


def test_killed_in_the_middle_the_same_command_ends_with_the_same_results(whole, tmp_path):
    study = tmp_path / "killed"
    process = studies.start(study)
    until = time.monotonic() + 120
    while not list(study.glob("runs/*/checkpoints/*")) and time.monotonic() < until:
        time.sleep(0.05)
    process.kill()
    studies.finish(process)
    code, _, errors = studies.finish(studies.start(study))
    said = [path.read_text() for path in sorted(study.glob("logs/*.log"))]
    assert (code, errors) == (0, ""), said
    assert studies.rows(study) == studies.rows(whole[0])


def test_a_full_disk_is_one_line_and_loses_nothing(monkeypatch, capsys, study):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = (study / "results.jsonl").read_bytes()
    monkeypatch.setattr(files, "replace", full)
    monkeypatch.setattr(sys, "argv", ["reproduce", str(study), *studies.SHAPE])
    with pytest.raises(SystemExit) as stop:
        main()
    out, err = capsys.readouterr()
    assert (stop.value.code, out) == (2, "")
    assert (
        err
        == f"error: study {study}: must be a directory that can be written (No space left on device)\n"
    )
    assert (study / "results.jsonl").read_bytes() == before


@pytest.mark.slow
def test_a_signal_stops_all_cells_with_a_checkpoint_and_the_same_command_goes_on(whole, tmp_path):
    study, long = tmp_path / "stopped", ["--total-steps", "100_000_000"]
    process = studies.start(study, *long)
    until = time.monotonic() + 120
    while len(list(study.glob("runs/*/metrics.jsonl"))) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    time.sleep(1)
    process.send_signal(signal.SIGTERM)
    code, lines, _ = studies.finish(process)
    assert code == 143
    assert lines[-1] == "stopped by SIGTERM; the same command goes on"
    stopped = [
        path for path in study.glob("logs/*.log") if "stopped by SIGTERM" in path.read_text()
    ]
    assert len(stopped) == min(2, len(list(study.glob("runs/*"))))


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--envs", "hoper"], "error: --envs hoper: must be "),
        (["--algos", "sac"], "error: --algos sac: must be one of "),
        (["--launcher", "cloud"], "error: --launcher cloud: must be one of local, ray, slurm"),
        (["--scale", "2"], "error: --scale 2.0: must be above 0 and at most 1"),
        (
            ["--scale", "0.001"],
            "error: --scale 0.001: must be large enough for one iteration of ppo on ant, 2,048 of 1,000,000 samples",
        ),
        (
            ["--scale", "0.1", "--total-steps", "1000"],
            "error: --scale 0.1: must be left out with --total-steps",
        ),
        (["--seeds", "0", "0"], "error: --seeds 0 0: must be at least one, each once"),
        (["--preset", "best"], "error: --preset best: must be one of tuned, paper"),
        (["--gama", "0.9"], "error: "),
        (
            ["--env", "ant", "--envs", "hopper"],
            "error: --env ant: must be left out: --envs says which",
        ),
        (["--algo", "ppo"], "error: --algo ppo: must be left out: --algos says which"),
        (
            ["--seed", "3"],
            "error: --seed 3: must be left out: --seeds and --seeds-per-run say which",
        ),
        (["--run-dir", "x"], "error: --run-dir x: must be left out: it is of one run alone"),
        (
            ["--config", "nowhere.json"],
            "error: --config nowhere.json: must be used with one of --algos",
        ),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(monkeypatch, capsys, tmp_path, argv, message):
    monkeypatch.setattr(sys, "argv", ["reproduce", str(tmp_path / "study"), *argv])
    with pytest.raises(SystemExit) as stop:
        main()
    out, err = capsys.readouterr()
    assert (stop.value.code, out) == (2, "")
    assert err.startswith(message)
    assert err.count("\n") == 1
    assert not (tmp_path / "study").exists()
