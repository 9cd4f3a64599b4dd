"""Metric loggers, read back from what they wrote."""

import importlib.util
import json
import shutil
import struct
from collections import Counter
from unittest.mock import Mock

import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import directory, files, loggers, metrics
from dgae_jax.run.options import METRIC_LOGGERS, RunOptions, validate_options
from tests.runs import SMALL, assert_same, exit_code, small, stopped_half_way

CONFIG = small("a2c", seeds=3)


def needs(name):
    reason, missing = f"{METRIC_LOGGERS[name]} is not installed", name not in INSTALLED
    return pytest.mark.skipif(missing, reason=reason)


INSTALLED = tuple(name for name, x in METRIC_LOGGERS.items() if importlib.util.find_spec(x))
READABLE = [pytest.param(name, marks=needs(name)) for name in METRIC_LOGGERS]
ACCOUNTS = ("WANDB_MODE", "WANDB_API_KEY", "WANDB_PROJECT")
ACCOUNTS += ("MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME")


@pytest.fixture(autouse=True, scope="module")
def _no_accounts(tmp_path_factory):
    """Log out everywhere, so that nothing is sent."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        for name in ACCOUNTS:
            patch.delenv(name, raising=False)
        patch.setenv("NETRC", str(home / "none"))
        for name in ("WANDB_CONFIG_DIR", "WANDB_CACHE_DIR", "WANDB_DATA_DIR"):
            patch.setenv(name, str(home))
        patch.setenv("WANDB_ERROR_REPORTING", "false")
        yield


def events(run_dir, seed):
    """Yield TensorBoard's events: length and its checksum, the event and its checksum."""
    from tensorboardX.proto.event_pb2 import Event

    for path in sorted((run_dir / "tensorboard" / f"seed_{seed}").iterdir()):
        data = path.read_bytes()
        while data:
            (size,) = struct.unpack("<Q", data[:8])
            yield Event.FromString(data[12 : 12 + size])
            data = data[16 + size :]


def read_tensorboard(run_dir, seed):
    return [
        (event.step, value.tag, value.simple_value)
        for event in events(run_dir, seed)
        for value in event.summary.value
        if value.WhichOneof("value") == "simple_value"
    ]


def records(path):
    """Yield the records of a file of Weights & Biases, a LevelDB log in blocks of 32 KiB."""
    data, at, parts = path.read_bytes(), 7, b""
    while at < len(data):
        left = 32768 - at % 32768
        if left < 7:
            at += left
            continue
        _, size, kind = struct.unpack("<IHB", data[at : at + 7])
        parts, at = parts + data[at + 7 : at + 7 + size], at + 7 + size
        if kind in (1, 4):  # whole, or the last part
            yield parts
            parts = b""


def logger_id(run_dir, name, seed):
    return files.read_object(run_dir / "sinks.json")[name]["ids"][str(seed)]


def read_wandb(run_dir, seed):
    from wandb.proto.wandb_internal_pb2 import Record

    found = []
    name = logger_id(run_dir, "wandb", seed)
    for path in sorted(run_dir.glob(f"wandb/offline-run-*/run-{name}.wandb")):
        for record in map(Record.FromString, records(path)):
            # an item with several keys is a picture
            items = [item for item in record.history.item if len(item.nested_key) < 2]
            row = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in items}
            names = [k for k in row if k != "steps" and not k.startswith("_")]
            found += [(row["steps"], k, row[k]) for k in names]
    return found


def mlflow_client(run_dir):
    from mlflow import MlflowClient

    return MlflowClient(f"sqlite:///{run_dir / 'mlflow' / 'mlflow.db'}")


def read_mlflow(run_dir, seed):
    client, name = mlflow_client(run_dir), logger_id(run_dir, "mlflow", seed)
    keys = client.get_run(name).data.metrics
    return [(m.step, m.key, m.value) for k in keys for m in client.get_metric_history(name, k)]


READ = {"tensorboard": read_tensorboard, "wandb": read_wandb, "mlflow": read_mlflow}


def check(name, run_dir, seed):
    """Compare a logger with the run's files: each number once, a float32 in TensorBoard."""
    found, ours = READ[name](run_dir, seed), {}
    for file, prefix in (("metrics", ""), ("evaluations", "evaluation/")):
        for row in (row for row in metrics.read(run_dir / f"{file}.jsonl") if row["seed"] == seed):
            ours |= {(row["steps"], prefix + k): x for k, x in row.items() if x is not None}
    left_out = "steps", "seed", *(f"evaluation/{k}" for k in ("steps", "seed", "returns"))
    ours = {key: x for key, x in ours.items() if key[1] not in left_out}
    assert Counter((step, key) for step, key, _ in found) == Counter(ours.keys())
    kind = np.float32 if name == "tensorboard" else float
    theirs = {(step, key): x for step, key, x in found}
    for (step, key), x in ours.items():  # a resumed run has logged the times of its first attempt
        assert key == "seconds" or theirs[step, key] == kind(x)


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """The run `three_seeds` with all loggers that are installed."""
    run_dir = tmp_path_factory.mktemp("runs") / "logged"
    assert exit_code(CONFIG, run_dir=run_dir, log=INSTALLED) == 0
    return run_dir


@pytest.mark.parametrize("name", READABLE)
def test_logger_has_every_number_once(name, logged):
    check(name, logged, 0)
    check(name, logged, 1)


def test_loggers_change_no_bit(three_seeds, logged):
    assert_same(logged, three_seeds)
    assert not (three_seeds / "sinks.json").exists()


@pytest.mark.parametrize("name", READABLE)
def test_resumed_run_logs_each_step_once(name, logged, tmp_path):
    run_dir = tmp_path / "half"
    stopped_half_way(logged, run_dir)
    assert directory.saved_options(run_dir).log == INSTALLED
    assert exit_code(CONFIG, resume=run_dir, log=(name,)) == 0
    check(name, run_dir, 1)


@pytest.mark.parametrize("name", READABLE)
def test_logger_that_is_added_later_gets_what_came_before(name, three_seeds, tmp_path):
    run_dir = shutil.copytree(three_seeds, tmp_path / "run")
    loggers.LoggerFeed((name,), run_dir, CONFIG).close(finished=True)
    check(name, run_dir, 0)


@needs("tensorboard")
def test_tensorboard_has_configuration_and_curve(logged):
    values = {v.tag: v for event in events(logged, 1) for v in event.summary.value}
    text = values["configuration/text_summary"].tensor.string_val[0].decode()
    assert "| gae_lambda | 0.95 |" in text
    assert "| seed | 1 |" in text
    image = values["curve.png"].image
    assert (image.width, image.height) == (960, 600)


@needs("mlflow")
def test_mlflow_has_configuration_curve_and_status(logged):
    client = mlflow_client(logged)
    found = client.search_runs([client.get_experiment_by_name("dgae_jax").experiment_id])
    assert sorted(run.info.run_name for run in found) == [f"logged-seed-{i}" for i in range(3)]
    for run in found:
        assert run.data.params["gae_lambda"] == "0.95"
        assert run.data.params["seed"] == run.info.run_name[-1]
        assert run.info.status == "FINISHED"


@needs("wandb")
def test_wandb_stays_offline_without_login(logged):
    pictures = logged.glob("wandb/offline-run-*/files/media/images/*.png")
    assert len(list(pictures)) == CONFIG.num_seeds


@pytest.mark.parametrize("at", ["open", "log", "close"])
def test_failing_logger_costs_one_warning(at, three_seeds, tmp_path, capsys, monkeypatch):
    run_dir, failing = shutil.copytree(three_seeds, tmp_path / "run"), Mock(id=None)
    opened = Mock(return_value=failing)
    method = opened if at == "open" else getattr(failing, at)
    method.side_effect = ConnectionError("the network is gone\nmore")
    monkeypatch.setitem(loggers.LOGGERS, "tensorboard", opened)
    feed = loggers.LoggerFeed(("tensorboard",), run_dir, CONFIG)
    feed.log([])
    feed.close(finished=True)
    method.assert_called_once()
    why = "ConnectionError: the network is gone"
    rest = "the run continues, and --resume adds what is missing"
    assert capsys.readouterr().err == f"warning: --log tensorboard stops here ({why}); {rest}\n"


def test_unknown_or_missing_logger_is_refused(tmp_path, monkeypatch):
    def refused(message, *log):
        with pytest.raises(ConfigError, match=message):
            validate_options(RunOptions(log=log), SMALL)

    refused("log visdom: must be one or more of tensorboard, wandb, mlflow", "visdom")
    (tmp_path / "a_folder").mkdir()  # as wandb leaves, is no library
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(METRIC_LOGGERS, "wandb", "a_folder")
    refused(r'log wandb: a_folder is missing; pip install "dgae_jax\[wandb\]"', "wandb")
