"""Tunings: trials, the processes that share them, and the outcome."""

import csv
import dataclasses
import json
import os
import signal
from concurrent.futures import ThreadPoolExecutor

import optuna
import pytest
from optuna.trial import TrialState

from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.run import directory, runtime
from dgae_jax.run.options import RunOptions
from dgae_jax.run.training import RunError
from dgae_jax.study import tune
from dgae_jax.study.search import Tuning, space_of
from dgae_jax.study.tune import open_study, work
from tests import studies
from tests.helpers import TINY
from tests.runs import QUIET, small

OPTIONS = RunOptions(cache_dir=QUIET.cache_dir, episodes=1, num_processes=1)
GAMMAS = ("gamma=0.9:0.999", "gae_lambda=0.8:1")


def tuning(path, words=GAMMAS, **changes):
    path.mkdir(exist_ok=True)
    config = changes.pop("config", small())
    defaults = {"options": OPTIONS, "trials": 1, "seeds": 1}
    return Tuning(config, space_of(words, config), path, **{**defaults, **changes})


def start(study, *more):
    """Start the real command on trials of eight iterations."""
    shape = ["--total-steps", "512", "--episode-length", "20", "--episodes", "1", *TINY]
    words = ["--study", study, "--algo", "ppo", "--tuning-seeds", "1", *shape, *more]
    return studies.command("experiments/tune.py", *words)


def table_of(study):
    return list(csv.DictReader((study / "trials.csv").read_text().splitlines()))


def test_a_tuning_finishes_its_trials_and_prints_the_best(tmp_path):
    study = tmp_path / "first"
    lines = studies.succeed(start(study, "--trials", "2", "--workers", "1"))
    rows = table_of(study)
    assert [row["trial"] for row in rows] == ["0", "1"]
    assert (float(rows[0]["gamma"]), float(rows[0]["gae_lambda"])) == (0.995, 0.95)  # the preset's
    best = sorted(rows, key=lambda row: -float(row["return_mean"]))
    assert [line.split(":")[0] for line in lines[-3:-1]] == [
        f"trial {row['trial']}" for row in best
    ]
    assert lines[-1] == f"train with the best settings: dgae train --config {study / 'best.json'}"
    page = (study / "tuning.html").read_text()
    assert page.count('src="data:image/png;base64,') == page.count("<img alt=") == 3
    assert "http" not in page
    run_dir = study / "trials" / best[0]["trial"].zfill(4)
    result = json.loads((run_dir / "evaluation.json").read_text())
    assert float(best[0]["return_mean"]) == result["return_mean"]
    trained = directory.read_config(run_dir)
    assert (trained.seed, trained.num_seeds) == (1000, 1)
    assert dataclasses.replace(trained, seed=0) == directory.read_config_file(study / "best.json")


@pytest.mark.parametrize(
    ("words", "starts"),
    [
        (["gamma=0.9:0.999"], [{"gamma": 0.99}]),
        (["policy.hidden=64x64,32", "gamma=0.9,0.99"], [{"policy.hidden": "64x64", "gamma": 0.99}]),
        (["gamma=0.995:0.999"], []),
    ],
)
def test_the_first_trial_is_the_configuration_if_it_is_inside(tmp_path, words, starts):
    config = resolve(Config(algo="ppo", gamma=0.99))
    study = open_study(tuning(tmp_path, words, config=config))
    assert [trial.system_attrs["fixed_params"] for trial in study.trials] == starts


@pytest.mark.parametrize(
    "changes",
    [
        {"seeds": 2},
        {"options": dataclasses.replace(OPTIONS, episodes=5)},
        {"config": dataclasses.replace(small(), num_envs=8)},
        {"words": ("gamma=0.5:0.6",)},
    ],
)
def test_another_tuning_in_the_same_study_is_refused(tmp_path, changes):
    open_study(tuning(tmp_path))
    open_study(tuning(tmp_path))
    with pytest.raises(ConfigError, match="must be new, or of the same settings"):
        open_study(tuning(tmp_path, **changes))


def test_a_run_that_stops_is_retried_where_it_was(tmp_path, monkeypatch):
    ours = tuning(tmp_path)
    study = open_study(ours)
    with pytest.warns(UserWarning, match="Heartbeat"):
        study.ask({})  # by a process that was lost before its first heartbeat
    train, directories = tune.training.train, []

    def stopped_at_first(config, options, on_eval):
        directories.append(options.run_dir)
        if len(directories) == 1:
            raise RunError(130, "stopped by SIGINT")
        return train(config, options, on_eval)

    monkeypatch.setattr(tune.training, "train", stopped_at_first)
    assert [work(ours), work(ours)] == [130, 0]
    _, stopped, again = study.trials
    assert (stopped.state, again.state) == (TrialState.FAIL, TrialState.COMPLETE)
    assert stopped.params == again.params
    assert directories == [ours.directory / "trials" / "0001"] * 2


def test_a_hopeless_trial_is_pruned_after_its_first_quarter(tmp_path, monkeypatch):
    monkeypatch.setattr(optuna.pruners.MedianPruner, "prune", lambda *_: True)
    ours = tuning(tmp_path)
    assert work(ours) == 0
    (trial,) = open_study(ours).trials
    assert trial.state == TrialState.PRUNED
    assert trial.intermediate_values == {1: trial.value}
    rows = (ours.directory / "trials" / "0000" / "metrics.jsonl").read_text().splitlines()
    assert len(rows) == 2  # of eight iterations


@pytest.mark.parametrize("reason", ["diverging", "invalid together", "too large"])
def test_values_that_cannot_be_trained_are_pruned(tmp_path, monkeypatch, reason):
    changes = {}
    if reason == "diverging":
        words = ("policy.learning_rate=1e29,1e30",)
        config = small().as_config().replace(**{"policy.max_grad_norm": 1e30})
        options = dataclasses.replace(OPTIONS, max_nonfinite=1)
        changes = {"config": resolve(config), "options": options}
    elif reason == "invalid together":
        words = ("num_envs=2,4", "num_steps=8,16", "policy.minibatches=4,32")
        values = {"num_envs": 2, "num_steps": 8, "policy.minibatches": 32}
        monkeypatch.setattr(Tuning, "start_values", lambda _: values)
    else:
        words = ("policy.hidden=4000x4000,4096x4096",)
        monkeypatch.setattr(runtime, "available_memory", lambda: 2**26)
    ours = tuning(tmp_path, words, **changes)
    assert work(ours) == 0
    (trial,) = tune.finished(open_study(ours))
    assert (trial.state, trial.value) == (TrialState.PRUNED, None)


def test_a_machine_that_cannot_train_takes_no_trial(tmp_path):
    ours = tuning(tmp_path, options=dataclasses.replace(OPTIONS, devices=99_999))
    with pytest.raises(ConfigError, match="devices 99999: must be at most"):
        work(ours)
    assert [trial.state for trial in open_study(ours).trials] == [TrialState.WAITING]


def test_a_database_that_is_not_there_is_refused_without_its_password(tmp_path):
    url = "postgresql+psycopg://me:secret@127.0.0.1:1/db"
    with pytest.raises(ConfigError, match="storage: must be a database that answers") as refused:
        open_study(tuning(tmp_path, storage=url))
    assert "secret" not in str(refused.value)


@pytest.mark.slow
def test_a_killed_worker_is_made_up_for(tmp_path):
    config = dataclasses.replace(small(), total_steps=64 * 400)
    ours = tuning(tmp_path, trials=3, workers=2, config=config)
    with ThreadPoolExecutor() as pool:
        code = pool.submit(tune.tune, ours)
        studies.wait_for(lambda: len(list(tmp_path.glob("trials/*/metrics.jsonl"))) == 2)
        os.kill(studies.first_child(), signal.SIGKILL)
        assert code.result() == 0
    study = open_study(ours)
    (lost,) = study.get_trials(states=(TrialState.FAIL,))
    (again,) = [t for t in study.trials if t.system_attrs.get("failed_trial") == lost.number]
    assert again.params == lost.params
    assert len(tune.finished(study)) == 3


@pytest.mark.slow
def test_a_signal_stops_it_and_the_same_command_continues(tmp_path):
    more = ["--trials", "2", "--workers", "1", "--total-steps", str(64 * 600)]
    process = start(tmp_path, *more)
    studies.wait_for(lambda: list(tmp_path.glob("trials/0000/checkpoints/*.msgpack")))
    process.send_signal(signal.SIGINT)
    code, lines, _ = studies.finish(process)
    assert (code, lines[-1][:30]) == (130, "stopped by SIGINT; the same co")
    studies.succeed(start(tmp_path, *more))
    assert "resuming from steps_" in (tmp_path / "worker-0.log").read_text()
    assert [path.name for path in sorted((tmp_path / "trials").iterdir())] == ["0000", "0002"]


@pytest.mark.slow
def test_machines_share_a_study_in_postgresql(postgres, tmp_path):
    places = [tmp_path / machine / "shared" for machine in ("one", "two")]
    more = ["--storage", postgres, "--trials", "4", "--workers", "1"]
    first = start(places[0], *more)
    studies.wait_for(lambda: (places[0] / "worker-0.log").exists())  # the tables are there
    for process in (start(places[1], *more), first):
        studies.succeed(process)
    assert table_of(places[0]) == table_of(places[1])
    assert len(table_of(places[0])) >= 4
    assert (places[0] / "best.json").read_bytes() == (places[1] / "best.json").read_bytes()
    assert not (places[0] / "optuna.db").exists()
