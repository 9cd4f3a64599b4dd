"""Tunings: trials, the processes that share them, and what is left when they are through."""

import csv
import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import time
import warnings

import optuna
import pytest
from optuna.trial import TrialState, create_trial

from dgae_jax.cli.train import parsed
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.presets import preset
from dgae_jax.run import directory, files, runtime, training
from dgae_jax.run.options import RunOptions
from dgae_jax.run.runtime import Signals
from dgae_jax.study import outcome, side_by_side, tune, worker
from dgae_jax.study.search import space_of
from dgae_jax.study.storage import distributions, open_storage, open_study, requeue
from dgae_jax.study.trials import finished, take
from dgae_jax.study.tuning import Tuning, value_of
from tests.helpers import ROOT, TINY, command
from tests.runs import QUIET, small

OPTIONS = RunOptions(cache_dir=QUIET.cache_dir, episodes=1)


@pytest.fixture(autouse=True)
def _features_may_change():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        warnings.filterwarnings(
            "ignore", "Heartbeat of storage"
        )  # of asking outside of Optuna's own loop
        yield


def tuning(path, *words, **changes):
    config = changes.pop("config", small())
    space = space_of(words or ("gamma=0.9:0.999", "lam=0.8:1"), config)
    return Tuning(
        config,
        space,
        path,
        **{"options": OPTIONS, "trials": 3, "seeds": 1, "heartbeat": 1, **changes},
    )


def opened(ours):
    ours.directory.mkdir(exist_ok=True)
    storage = open_storage(ours)
    return storage, open_study(ours, storage)


def start(study, *more):
    """The real command on trials of eight iterations."""
    argv = [
        "--study",
        str(study),
        "--algo",
        "ppo",
        "--total-steps",
        "512",
        "--episode-length",
        "20",
        "--episodes",
        "1",
        *TINY,
        *more,
    ]
    words = [sys.executable, "experiments/tune.py", "--tuning-seeds", "1", *argv]
    return subprocess.Popen(
        words, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def table_of(study):
    return list(csv.DictReader((study / "trials.csv").read_text().splitlines()))


def wait_for(what, seconds=120):
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def running(study):
    """Trials that a process has given a sign of life for."""
    return sum(
        "taken" in trial.user_attrs for trial in study.get_trials(states=(TrialState.RUNNING,))
    )


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """A finished tuning by the real command with two processes, and what it printed."""
    study = tmp_path_factory.mktemp("tunings") / "first"
    process = start(study, "--trials", "5")
    out, errors = process.communicate(timeout=300)
    assert (process.returncode, errors) == (0, ""), out
    return study, out.splitlines()


def test_a_tuning_finishes_as_many_trials_as_were_asked_for_and_leaves_them_in_a_table(tuned):
    study, lines = tuned
    rows = table_of(study)
    assert [row["trial"] for row in rows] == list("01234")
    assert {row["state"] for row in rows} <= {"complete", "pruned"}
    assert sum(line.startswith("trial ") and "; best " in line for line in lines) == 5
    assert all(
        0.95 <= float(row["gamma"]) <= 0.9999 and 0.5 <= float(row["lam"]) <= 1 for row in rows
    )
    assert len({row["gamma"] for row in rows}) == 5


def test_a_start_outside_of_what_is_searched_is_no_trial_and_said_to_be_none(tmp_path):
    assert tuning(tmp_path / "within", "gamma=0.9:0.999").outside == {}
    outside = tuning(tmp_path / "outside", "gamma=0.995:0.999")
    assert outside.outside == {"gamma": 0.99}
    assert opened(outside)[1].get_trials() == []
    assert len(opened(tuning(tmp_path / "within", "gamma=0.9:0.999"))[1].get_trials()) == 1


def test_the_first_trial_is_the_preset_itself(tuned):
    rows = table_of(tuned[0])
    start = preset("tuned", "ppo", "hopper")
    assert (float(rows[0]["gamma"]), float(rows[0]["lam"])) == (start.gamma, start.lam)


def test_each_trial_is_an_ordinary_run_of_seeds_that_reports_do_not_use(tuned):
    study, _ = tuned
    for number in range(5):
        config = directory.read_config(study / "trials" / f"{number:04d}")
        assert (config.seed, config.num_seeds, config.total_steps) == (1000, 1, 512)


def test_the_best_file_is_a_configuration_to_train_from_with_the_settings_of_the_best_trial(tuned):
    study, lines = tuned
    rows = [row for row in table_of(study) if row["state"] == "complete"]
    best = max(rows, key=lambda row: float(row["return_mean"]))
    result = json.loads(
        (study / "trials" / f"{int(best['trial']):04d}" / "evaluation.json").read_text()
    )
    assert float(best["return_mean"]) == result["return_mean"]
    config, _ = parsed(["--config", str(study / "best.json")])
    assert (config.gamma, config.gae_lambda) == (float(best["gamma"]), float(best["lam"]))
    assert (config.seed, config.num_seeds, config.algo, config.num_envs) == (0, 1, "ppo", 4)
    assert lines[-1] == f"train with the best settings: dgae train --config {study / 'best.json'}"


def test_the_printed_table_is_aligned_and_has_the_best_first(tuned):
    _, lines = tuned
    head = next(
        i for i, line in enumerate(lines) if line.split() == ["trial", "return", "gamma", "lam"]
    )
    table = lines[head : next(i for i, line in enumerate(lines) if " of them pruned; " in line)]
    assert {len(line) for line in table} == {len(table[0])}
    assert len(table[0]) <= 80
    returns = [float(line.split()[1].replace(",", "")) for line in table[1:]]
    assert returns == sorted(returns, reverse=True)


def test_the_page_is_one_file_whose_pictures_have_words(tuned):
    page = (tuned[0] / "tuning.html").read_text()
    images = page.count("<img ")
    assert images >= 1
    assert page.count('src="data:image/png;base64,') == images == page.count('<img alt="')
    assert "http" not in page
    assert '<meta name="viewport"' in page
    assert "prefers-color-scheme: dark" in page
    assert (tuned[0] / "history.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_tuning_that_is_over_is_reported_again_and_more_trials_go_on_from_it(tuned):
    study, _ = tuned
    before = table_of(study)
    process = start(study, "--trials", "6", "--workers", "1")
    out, errors = process.communicate(timeout=300)
    assert (process.returncode, errors) == (0, "")
    assert out.splitlines()[0] == "going on after 5 finished trials"
    after = table_of(study)
    assert (after[:5], len(after)) == (before, 6)


def test_a_study_that_tunes_something_else_is_refused_with_both_values(tuned):
    process = start(tuned[0], "--search", "gamma=0.5:0.6", "--trials", "5")
    out, errors = process.communicate(timeout=120)
    assert (process.returncode, out) == (2, "")
    assert (
        errors
        == "error: --search gamma 0.5:0.6: must be 0.95:0.9999 as in the study first, or with another --study\n"
    )


def test_a_killed_process_loses_no_finished_trial_and_the_others_finish_its_own(tmp_path):
    ours = tuning(
        tmp_path / "study",
        trials=4,
        workers=2,
        config=dataclasses.replace(small(), total_steps=64 * 200),
    )
    _, study = opened(ours)
    processes = tune.start(ours)
    wait_for(lambda: finished(study) and running(study) == 2)
    before = {trial.number: trial.value for trial in finished(study)}
    processes[0].kill()
    for process in processes:
        process.join(240)
    assert [process.exitcode for process in processes] == [-signal.SIGKILL, 0]
    after = {trial.number: trial.value for trial in finished(study)}
    assert len(after) == 4
    assert before.items() <= after.items()
    lost = [trial.number for trial in study.get_trials(deepcopy=False, states=(TrialState.FAIL,))]
    again = [t.number for t in finished(study) if t.system_attrs.get("failed_trial") in lost]
    assert (len(lost), len(again)) == (1, 1)


@pytest.mark.slow
def test_a_signal_stops_it_with_its_exit_code_and_the_same_command_goes_on_where_it_was(tmp_path):
    study = tmp_path / "study"
    more = ["--trials", "2", "--workers", "1", "--total-steps", str(64 * 600)]
    process = start(study, *more)
    wait_for(lambda: list((study / "trials").glob("0000/checkpoints/*.msgpack")))
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert (
        errors
        == "SIGINT: finishing what is running, then saving; a second signal ends it at once\n"
    )
    assert (
        out.splitlines()[-1]
        == "stopped by SIGINT: 0 of 2 trials are finished; the same command goes on"
    )
    process = start(study, *more)
    out, errors = process.communicate(timeout=240)
    assert (process.returncode, errors) == (0, ""), out
    assert "resuming from steps_" in (study / "worker-0.log").read_text()
    assert len(table_of(study)) == 2
    assert [path.name for path in sorted((study / "trials").iterdir())] == ["0000", "0002"]


@pytest.mark.slow
def test_machines_without_a_common_disk_share_a_study_in_postgresql(postgres, tmp_path):
    places = [tmp_path / machine / "shared" for machine in ("one", "two")]
    processes = [
        start(place, "--storage", postgres, "--trials", "4", "--workers", "1") for place in places
    ]
    for process in processes:
        out, errors = process.communicate(timeout=300)
        assert (process.returncode, errors) == (0, ""), out
    tables = [table_of(place) for place in places]
    assert tables[0] == tables[1]
    assert len(tables[0]) == 4
    assert (places[0] / "best.json").read_bytes() == (places[1] / "best.json").read_bytes()
    runs = [sorted(path.name for path in (place / "trials").iterdir()) for place in places]
    assert sorted(runs[0] + runs[1]) == [row["trial"].zfill(4) for row in tables[0]]
    assert not (places[0] / "optuna.db").exists()


@pytest.mark.slow
@pytest.mark.slow
def test_a_process_that_is_killed_is_made_up_for_through_postgresql_too(postgres, tmp_path):
    slow = dataclasses.replace(small(), total_steps=64 * 200)
    url = postgres.replace("postgresql:", "postgresql+psycopg:")
    ours = tuning(tmp_path / "killed", trials=3, workers=2, storage=url, config=slow)
    storage, study = opened(ours)
    processes = tune.start(ours)
    wait_for(lambda: running(study) == 2)
    processes[1].kill()
    processes[0].join(240)
    assert processes[0].exitcode == 0
    assert len(finished(study)) == 3
    storage.remove_session()
    storage.engine.dispose()


@pytest.mark.slow
def test_trials_side_by_side_are_worth_what_they_are_alone(tmp_path):
    ours = tuning(tmp_path / "study", side_by_side=3, seeds=2)
    _, study = opened(ours)
    trials = take(study, ours)
    assert len({trial.params["gamma"] for trial in trials}) == 3
    with Signals() as signals:
        values = side_by_side.train(ours, study, trials, signals)
    alone = [
        training.train(
            ours.config_of(trial.params),
            dataclasses.replace(OPTIONS, run_dir=tmp_path / str(trial.number)),
        )
        for trial in trials
    ]
    assert values == pytest.approx([value_of(run.evaluation) for run in alone], rel=1e-3)
    assert len(set(values)) == 3
    assert [
        directory.read_config_file(ours.directory / "trials" / f"000{i}" / "config.json").gamma
        for i in range(3)
    ] == [trial.params["gamma"] for trial in trials]


def test_a_worker_trains_what_is_left_side_by_side(tmp_path):
    ours = tuning(tmp_path / "study", side_by_side=2, trials=3)
    _, study = opened(ours)
    assert worker.serve(ours, 0) == 0
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE] * 3
    assert study.trials[0].params == {"gamma": 0.99, "lam": 0.95}


class Hopeless(optuna.pruners.BasePruner):
    def prune(self, study, trial):
        return True


@pytest.mark.parametrize("side_by_side", [1, 2])
def test_a_trial_worse_than_most_ends_after_its_first_quarter_with_the_return_that_it_had(
    side_by_side, tmp_path, monkeypatch
):
    monkeypatch.setattr(optuna.pruners, "MedianPruner", Hopeless)
    ours = tuning(tmp_path / "study", side_by_side=side_by_side, trials=side_by_side)
    _, study = opened(ours)
    assert worker.serve(ours, 0) == 0
    for trial in study.trials:
        assert trial.state == TrialState.PRUNED
        assert list(trial.intermediate_values) == [1]
        assert trial.value == trial.intermediate_values[1]
    if side_by_side == 1:
        rows = (ours.directory / "trials" / "0000" / "metrics.jsonl").read_text().splitlines()
        assert len(rows) == 2  # of eight iterations


def test_settings_that_break_down_count_as_a_trial_without_a_return(tmp_path):
    config = dataclasses.replace(
        small(), policy=dataclasses.replace(small().policy, max_grad_norm=1e30)
    )
    words = ("policy.learning_rate=1e29,1e30",)
    ours = tuning(
        tmp_path / "study",
        *words,
        config=config,
        options=dataclasses.replace(OPTIONS, max_nonfinite=1),
        trials=1,
    )
    _, study = opened(ours)
    assert worker.serve(ours, 0) == 0
    assert [(trial.state, trial.value) for trial in finished(study)] == [(TrialState.PRUNED, None)]


def test_values_that_do_not_go_together_count_as_a_trial_without_a_return(tmp_path):
    ours = tuning(
        tmp_path / "study", "num_envs=2,4", "num_steps=8,16", "policy.minibatches=4,32", trials=2
    )
    _, study = opened(ours)
    study.enqueue_trial(
        {"num_envs": 2, "num_steps": 8, "policy.minibatches": 32}
    )  # 16 samples in 32 minibatches
    assert worker.serve(ours, 0) == 0
    assert [trial.state for trial in finished(study)] == [TrialState.COMPLETE, TrialState.PRUNED]
    assert study.trials[1].value is None
    assert [path.name for path in (ours.directory / "trials").iterdir()] == ["0000"]


def test_values_that_do_not_fit_the_machine_count_as_a_trial_without_a_return(
    tmp_path, monkeypatch
):
    ours = tuning(tmp_path / "study", "policy.hidden=4000x4000,4096x4096", trials=1)
    _, study = opened(ours)
    monkeypatch.setattr(runtime, "available_memory", lambda: 2**26)
    assert worker.serve(ours, 0) == 0
    assert [(trial.state, trial.value) for trial in finished(study)] == [(TrialState.PRUNED, None)]


def test_a_machine_on_which_nothing_can_be_trained_takes_no_trial(tmp_path, capsys):
    ours = tuning(
        tmp_path / "study", options=dataclasses.replace(OPTIONS, cache_dir="/dev/null/below")
    )
    _, study = opened(ours)
    assert worker.serve(ours, 0) == 1
    assert (
        "stopped: cache_dir /dev/null/below: must be a directory that can be written"
        in capsys.readouterr().err
    )
    assert [trial.state for trial in study.trials] == [TrialState.WAITING]


def test_trials_that_are_all_worth_the_same_have_a_page_without_the_picture_of_their_spread(
    tmp_path,
):
    ours = tuning(tmp_path / "study")
    _, study = opened(ours)
    for gamma in (0.91, 0.92, 0.93, 0.94):
        study.add_trial(
            create_trial(
                params={"gamma": gamma, "lam": 0.9}, distributions=distributions(ours), value=0.0
            )
        )
    assert outcome.write(ours, study) == 0
    assert {path.name for path in ours.directory.iterdir()} >= {
        "history.png",
        "tuning.html",
        "best.json",
    }
    assert not (ours.directory / "importances.png").exists()


def test_a_full_disk_at_the_end_is_one_line(tmp_path, monkeypatch):
    def full(path, *_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    ours = tuning(tmp_path / "study", trials=1)
    _, study = opened(ours)
    study.add_trial(
        create_trial(
            params={"gamma": 0.91, "lam": 0.9}, distributions=distributions(ours), value=0.0
        )
    )
    monkeypatch.setattr(files, "replace", full)
    with pytest.raises(
        ConfigError,
        match=r"trials\.csv: must be a file that can be written \(No space left on device\)",
    ):
        tune.tune(ours)


def test_no_more_trials_are_taken_than_are_left(tmp_path):
    ours = tuning(tmp_path / "study", trials=3, side_by_side=2)
    _, study = opened(ours)
    assert [trial.number for trial in take(study, ours)] == [0, 1]
    assert [trial.number for trial in take(study, ours)] == [2]
    assert take(study, ours) == []
    requeue(
        study, study.ask()
    )  # a fourth, which another process took at the same moment and gave back
    assert take(study, ours) == []


def test_of_two_processes_that_take_the_last_trial_the_later_gives_way(tmp_path, monkeypatch):
    ours = tuning(tmp_path / "study", trials=1)
    storage, study = opened(ours)
    other, ask = open_study(ours, storage), study.ask
    monkeypatch.setattr(study, "ask", lambda space: (other.ask(space), ask(space))[1])
    assert take(study, ours) == []
    assert [trial.state for trial in study.trials] == [TrialState.RUNNING, TrialState.FAIL]


@pytest.fixture
def refusal(monkeypatch, capsys, tmp_path):
    """The line that a command line is refused with."""
    monkeypatch.chdir(tmp_path)

    def refusal(*argv):
        monkeypatch.setattr(sys, "argv", ["tune.py", "--algo", "ppo", "--physics", "native", *argv])
        with pytest.raises(SystemExit) as stop:
            command("tune")()
        out, errors = capsys.readouterr()
        assert (stop.value.code, out, errors.count("\n")) == (2, "", 1)
        assert list(tmp_path.iterdir()) == []
        return errors.removeprefix("error: ").rstrip()

    return refusal


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["--search", "gamma=0.9:2"], "--search gamma=0.9:2: must be valid throughout (gamma 2.0: must be a number from 0 to 1)"),
        (["--search", "policy.max_kl=0.1:0.2"],
         "--search policy.max_kl=0.1:0.2: must be valid throughout (policy.max_kl 0.1: must be left out: ppo with clip does not use it)"),
        (["--search"], "--search: must name a setting, gamma=0.95:0.999 for one"),
        (["--trials", "0"], "--trials 0: must be a whole number from 1 to 100,000 (Optuna reads all of them before each)"),
        (["--tuning-seeds", "0"], "--tuning-seeds 0: must be a whole number from 1 to 100 (every one is a whole run)"),
        (["--seed", "3"], "--seed: must be left out: --tuning-seeds says how many, from 1000 on"),
        (["--run_dir=x"], "--run-dir: must be left out: the trials are in --study, and go on by themselves"),
        (["--checkpoint-every", "5"], "--checkpoint-every: must be left out: a trial is looked at after each quarter"),
        (["--storage", "mysql://me:secret@host/db"],
         "--storage mysql://…: must be postgresql://USER:PASSWORD@HOST/NAME, or left out for SQLite"),
        (["--side-by-side", "4", "--search", "num_envs=8,16"], "--side-by-side 4: must be 1: another num_envs is another program"),
        (["--side-by-side", "4", "--log", "tensorboard"],
         "--log tensorboard: must be left out with --side-by-side, whose trials have no run directories"),
        (["--side-by-side", "4", "--debug-nonfinite"],
         "--debug-nonfinite True: must be left out with --side-by-side, whose trials have no run directories"),
        (["--gamma", "3"], "--gamma 3.0: must be a number from 0 to 1"),
        (["--clip", "0.1"], "--clip: is written --policy.clip_eps-eps"),
        (["--workers", "100000"], None),
        (["--no-such-flag"], None),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_before_anything_is_written(argv, line, refusal):
    said = refusal(*argv)
    assert line is None or said == line


def test_a_database_that_is_not_there_is_bad_input_and_its_password_is_not_shown(
    monkeypatch, capsys, tmp_path
):
    where = "postgresql://me:secret@127.0.0.1:1/db"
    monkeypatch.setattr(
        sys,
        "argv",
        ["tune.py", "--physics", "native", "--study", str(tmp_path / "study"), "--storage", where],
    )
    with pytest.raises(SystemExit) as stop:
        command("tune")()
    out, errors = capsys.readouterr()
    assert (stop.value.code, out, errors.count("\n")) == (2, "", 1)
    assert errors.startswith(
        "error: --storage postgresql+psycopg://me:***@127.0.0.1:1/db: must be a database that can be reached ("
    )


def test_a_study_of_something_else_is_refused_also_with_other_seeds(tmp_path):
    ours = tuning(tmp_path / "study")
    storage, _ = opened(ours)
    with pytest.raises(ConfigError, match="tuning_seeds 2: must be 1 as in the study study"):
        open_study(dataclasses.replace(ours, seeds=2), storage)
    for changes, message in (
        ({"episodes": 5}, "episodes 5: must be 1 as"),
        ({"eval_engine": "native"}, "eval_engine native: must be gymnasium as"),
    ):
        with pytest.raises(ConfigError, match=message):
            open_study(
                dataclasses.replace(ours, options=dataclasses.replace(OPTIONS, **changes)), storage
            )
    with pytest.raises(ConfigError, match="num_envs 8: must be 4 as in the study study"):
        open_study(
            dataclasses.replace(ours, config=dataclasses.replace(ours.config, num_envs=8)), storage
        )
