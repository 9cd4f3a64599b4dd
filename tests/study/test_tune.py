"""Tunings: trials, the processes that share them, and the outcome."""

import csv
import dataclasses
import json
import os
import signal
from concurrent.futures import ThreadPoolExecutor

import optuna
import pytest
from optuna.trial import TrialState, create_trial

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.run import directory, runtime
from dgae_jax.run.options import RunOptions
from dgae_jax.run.training import RunError
from dgae_jax.study import outcome, tune
from dgae_jax.study.outcome import FINISHED
from dgae_jax.study.search import Tuning, space_of
from dgae_jax.study.tune import open_study, work
from tests import studies
from tests.helpers import TINY
from tests.runs import QUIET, small

OPTIONS = RunOptions(cache_dir=QUIET.cache_dir, episodes=1)
GAMMAS = ("gamma=0.9:0.999", "gae_lambda=0.8:1")


def tuning(path, words=GAMMAS, **changes):
    config = changes.pop("config", small())
    defaults = {"options": OPTIONS, "trials": 2, "seeds": 1, "heartbeat": 1}
    return Tuning(config, space_of(words, config), path, **{**defaults, **changes})


def opened(ours):
    ours.directory.mkdir(exist_ok=True)
    return open_study(ours)


def states(study):
    return [trial.state for trial in study.trials]


def start(study, *more):
    """Start the real command on trials of eight iterations."""
    shape = ["--total-steps", "512", "--episode-length", "20", "--episodes", "1", *TINY]
    words = ["--study", study, "--algo", "ppo", "--tuning-seeds", "1", *shape, *more]
    return studies.command("experiments/tune.py", *words)


def table_of(study):
    return list(csv.DictReader((study / "trials.csv").read_text().splitlines()))


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """A tuning by the real command, and what it printed."""
    study = tmp_path_factory.mktemp("tunings") / "first"
    code, lines, errors = studies.finish(start(study, "--trials", "2", "--workers", "1"))
    assert (code, errors) == (0, ""), lines
    return study, lines


def test_a_tuning_finishes_its_trials_and_prints_the_best(tuned):
    study, lines = tuned
    rows = table_of(study)
    assert [row["trial"] for row in rows] == ["0", "1"]
    assert sum(line.startswith("trial ") and "complete" in line for line in lines) == 2
    assert (float(rows[0]["gamma"]), float(rows[0]["gae_lambda"])) == (0.995, 0.95)  # the preset's
    assert lines[-1] == f"train with the best settings: dgae train --config {study / 'best.json'}"
    head = next(i for i, line in enumerate(lines) if line.split()[:2] == ["trial", "state"])
    returns = [float(line.split()[2]) for line in lines[head + 1 : head + 3]]
    assert returns == sorted(returns, reverse=True)


def test_the_best_configuration_is_that_of_the_best_run(tuned):
    study, _ = tuned
    best = max(table_of(study), key=lambda row: float(row["return_mean"]))
    run_dir = study / "trials" / best["trial"].zfill(4)
    result = json.loads((run_dir / "evaluation.json").read_text())
    assert float(best["return_mean"]) == result["return_mean"]
    config = directory.read_config_file(study / "best.json")
    trained = directory.read_config(run_dir)
    assert (trained.seed, trained.num_seeds) == (1000, 1)
    assert dataclasses.replace(trained, seed=0) == config


def test_the_page_is_one_file(tuned):
    page = (tuned[0] / "tuning.html").read_text()
    assert page.count('src="data:image/png;base64,') == page.count("<img alt=") >= 1
    assert "http" not in page


def test_another_tuning_in_the_same_study_is_refused(tmp_path):
    ours = tuning(tmp_path / "study")
    opened(ours)
    opened(ours)
    for changes, message in (
        ({"seeds": 2}, "tuning_seeds 2: must be 1 as in"),
        ({"options": dataclasses.replace(OPTIONS, episodes=5)}, "episodes 5: must be 1 as"),
        ({"config": dataclasses.replace(ours.config, num_envs=8)}, "num_envs 8: must be 4 as"),
        ({"words": ("gamma=0.5:0.6",)}, "search gamma 0.5:0.6: must be 0.9:0.999 as"),
    ):
        with pytest.raises(ConfigError, match=message):
            open_study(tuning(ours.directory, **changes))


def test_a_run_that_stops_is_retried_where_it_was(tmp_path, monkeypatch):
    ours = tuning(tmp_path / "study", trials=1)
    study = opened(ours)
    train, directories = tune.training.train, []

    def stopped_at_first(config, options, on_eval):
        directories.append(options.run_dir)
        if len(directories) == 1:
            raise RunError(130, "stopped by SIGINT")
        return train(config, options, on_eval)

    monkeypatch.setattr(tune.training, "train", stopped_at_first)
    assert work(ours) == 130
    assert states(study) == [TrialState.FAIL, TrialState.WAITING]
    assert work(ours) == 0
    assert states(study) == [TrialState.FAIL, TrialState.COMPLETE]
    assert study.trials[0].params == study.trials[1].params == {"gamma": 0.99, "gae_lambda": 0.95}
    assert directories[0] == directories[1] == ours.directory / "trials" / "0000"


class AlwaysPruner(optuna.pruners.BasePruner):
    def prune(self, study, trial):
        return True


def test_a_hopeless_trial_is_pruned_after_its_first_quarter(tmp_path, monkeypatch):
    monkeypatch.setattr(optuna.pruners, "MedianPruner", AlwaysPruner)
    ours = tuning(tmp_path / "study", trials=1)
    study = opened(ours)
    assert work(ours) == 0
    (trial,) = study.trials
    assert trial.state == TrialState.PRUNED
    assert trial.intermediate_values == {1: trial.value}
    rows = (ours.directory / "trials" / "0000" / "metrics.jsonl").read_text().splitlines()
    assert len(rows) == 2  # of eight iterations


@pytest.mark.parametrize("reason", ["diverging", "invalid together", "too large"])
def test_values_that_cannot_be_trained_are_pruned(tmp_path, monkeypatch, reason):
    words, changes = ("gamma=0.9:0.999",), {}
    if reason == "diverging":
        config = small().as_config().replace(**{"policy.max_grad_norm": 1e30})
        words = ("policy.learning_rate=1e29,1e30",)
        changes = {"config": resolve(config)}
        changes["options"] = dataclasses.replace(OPTIONS, max_nonfinite=1)
    elif reason == "invalid together":
        words = ("num_envs=2,4", "num_steps=8,16", "policy.minibatches=4,32")
        start = {"num_envs": 2, "num_steps": 8, "policy.minibatches": 32}
        monkeypatch.setattr(Tuning, "start_values", lambda _: start)
    else:
        words = ("policy.hidden=4000x4000,4096x4096",)
        monkeypatch.setattr(runtime, "available_memory", lambda: 2**26)
    ours = tuning(tmp_path / "study", words, trials=1, **changes)
    study = opened(ours)
    assert work(ours) == 0
    (trial,) = study.get_trials(states=FINISHED)
    assert (trial.state, trial.value) == (TrialState.PRUNED, None)


def test_a_machine_that_cannot_train_takes_no_trial(tmp_path):
    options = dataclasses.replace(OPTIONS, cache_dir="/dev/null/below")
    ours = tuning(tmp_path / "study", options=options)
    study = opened(ours)
    with pytest.raises(ConfigError, match="cache_dir /dev/null/below: must be a directory"):
        work(ours)
    assert states(study) == [TrialState.WAITING]


@pytest.mark.parametrize(("spread", "images"), [(0.0, 2), (100.0, 3)])
def test_importances_are_plotted_where_returns_differ(tmp_path, spread, images):
    ours = tuning(tmp_path / "study")
    study = opened(ours)
    space = dict.fromkeys(ours.space, optuna.distributions.FloatDistribution(0.8, 1.0))
    for gamma in (0.91, 0.92, 0.93, 0.94):
        params, value = {"gamma": gamma, "gae_lambda": 0.9}, spread * gamma
        study.add_trial(create_trial(params=params, distributions=space, value=value))
    assert outcome.write(ours, study) == 0
    assert (ours.directory / "tuning.html").read_text().count("<img") == images


def test_a_database_that_is_not_there_is_refused_without_its_password(tmp_path):
    url = "postgresql+psycopg://me:secret@127.0.0.1:1/db"
    with pytest.raises(ConfigError, match=r"storage .*me:\*\*\*@.*: must be a database") as refused:
        open_study(tuning(tmp_path, storage=url))
    assert "secret" not in str(refused.value)


@pytest.mark.slow
def test_a_killed_worker_is_made_up_for(tmp_path):
    config = dataclasses.replace(small(), total_steps=64 * 400)
    ours = tuning(tmp_path / "study", trials=3, workers=2, config=config)
    study = opened(ours)
    study.ask()  # by a process that is lost before its first heartbeat
    with ThreadPoolExecutor() as pool:
        code = pool.submit(tune.tune, ours)
        studies.wait_for(lambda: len(list(ours.directory.glob("trials/*/metrics.jsonl"))) == 2)
        victim = studies.children()[0]
        os.kill(victim, signal.SIGKILL)
        assert code.result() == 0
    (lost,) = study.get_trials(states=(TrialState.FAIL,))
    (again,) = [t for t in study.trials if t.system_attrs.get("failed_trial") == lost.number]
    assert again.params == lost.params
    assert len(study.get_trials(states=FINISHED)) == 3


@pytest.mark.slow
def test_a_signal_stops_it_and_the_same_command_continues(tmp_path):
    study = tmp_path / "study"
    more = ["--trials", "2", "--workers", "1", "--total-steps", str(64 * 600)]
    process = start(study, *more)
    studies.wait_for(lambda: list(study.glob("trials/0000/checkpoints/*.msgpack")))
    process.send_signal(signal.SIGINT)
    code, lines, _ = studies.finish(process)
    assert code == 130
    assert lines[-1].startswith("stopped by SIGINT: 0 of 2 trials are finished")
    code, lines, errors = studies.finish(start(study, *more))
    assert (code, errors) == (0, ""), lines
    assert "resuming from steps_" in (study / "worker-0.log").read_text()
    assert [path.name for path in sorted((study / "trials").iterdir())] == ["0000", "0002"]


@pytest.mark.slow
def test_machines_share_a_study_in_postgresql(postgres, tmp_path):
    places = [tmp_path / machine / "shared" for machine in ("one", "two")]
    more = ["--storage", postgres, "--trials", "4", "--workers", "1"]
    first = start(places[0], *more)
    studies.wait_for(lambda: (places[0] / "worker-0.log").exists())  # the tables are there
    for code, lines, errors in (studies.finish(each) for each in (start(places[1], *more), first)):
        assert (code, errors) == (0, ""), lines
    assert table_of(places[0]) == table_of(places[1])
    assert len(table_of(places[0])) >= 4
    assert (places[0] / "best.json").read_bytes() == (places[1] / "best.json").read_bytes()
    assert all(list((place / "trials").iterdir()) for place in places)
    assert not (places[0] / "optuna.db").exists()
