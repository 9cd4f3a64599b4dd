"""What other people's viewers get of a run, read back from what they wrote."""

import dataclasses
import importlib.util
import json
import struct
from collections import Counter

import numpy as np
import pytest

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import directory, loggers, metrics, training
from dgae_jax.run.loggers import MetricLogger
from dgae_jax.run.options import METRIC_LOGGERS, RunOptions, validate_options
from tests.runs import QUIET, SMALL, last, small, stopped_half_way, timeless

SEEDS = 2


def present(name):
    return importlib.util.find_spec(METRIC_LOGGERS[name]) is not None


def needs(name):
    return pytest.mark.skipif(not present(name), reason=f"{METRIC_LOGGERS[name]} is not installed")


READABLE = [pytest.param(name, marks=needs(name)) for name in METRIC_LOGGERS]


@pytest.fixture(autouse=True)
def _no_accounts(monkeypatch, tmp_path):
    """Nobody is logged in anywhere, and nothing is sent."""
    for name in (
        "WANDB_MODE",
        "WANDB_API_KEY",
        "WANDB_PROJECT",
        "MLFLOW_TRACKING_URI",
        "MLFLOW_EXPERIMENT_NAME",
    ):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    for name in ("WANDB_CONFIG_DIR", "WANDB_CACHE_DIR", "WANDB_DATA_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    monkeypatch.setenv("WANDB_ERROR_REPORTING", "false")


def events(run_dir, seed):
    """The events of TensorBoard's files in their order: length and its checksum, the event and its checksum."""
    from tensorboardX.proto.event_pb2 import Event

    for path in sorted((run_dir / "tensorboard" / f"seed_{seed}").iterdir()):
        data = path.read_bytes()
        while data:
            (size,) = struct.unpack("<Q", data[:8])
            yield Event.FromString(data[12 : 12 + size])
            data = data[16 + size :]


def read_tensorboard(run_dir, seed):
    """As the viewer shows it: a session that starts at a step hides what was there from that step on."""
    from tensorboardX.proto.event_pb2 import SessionLog

    found = []
    for event in events(run_dir, seed):
        if event.session_log.status == SessionLog.START:
            found = [each for each in found if each[0] < event.step]
        found += [
            (event.step, v.tag, v.simple_value)
            for v in event.summary.value
            if v.WhichOneof("value") == "simple_value"
        ]
    return found


def records(path):
    """The records of a file of Weights & Biases: a log as LevelDB has it, in blocks of 32 KiB, behind a header of 7 bytes."""
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


def read_wandb(run_dir, seed):
    """Of all files of the run's id, in their order."""
    from wandb.proto.wandb_internal_pb2 import Record

    name, found = json.loads((run_dir / "sinks.json").read_text())["wandb"]["ids"][str(seed)], []
    for path in sorted(run_dir.glob(f"wandb/offline-run-*/run-{name}.wandb")):
        for record in map(Record.FromString, records(path)):
            items = [
                item for item in record.history.item if len(item.nested_key) < 2
            ]  # what has parts is a picture
            row = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in items}
            found += [
                (row["steps"], k, x)
                for k, x in row.items()
                if k != "steps" and not k.startswith("_")
            ]
    return found


def read_mlflow(run_dir, seed):
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{run_dir / 'mlflow' / 'mlflow.db'}")
    name = json.loads((run_dir / "sinks.json").read_text())["mlflow"]["ids"][str(seed)]
    return [
        (m.step, m.key, m.value)
        for key in client.get_run(name).data.metrics
        for m in client.get_metric_history(name, key)
    ]


READ = {"tensorboard": read_tensorboard, "wandb": read_wandb, "mlflow": read_mlflow}


def written(run_dir, seed):
    """What the run's own files say, by step and name."""
    rows = [row for row in metrics.read(run_dir / "metrics.jsonl") if row["seed"] == seed]
    looks = [row for row in metrics.read(run_dir / "evaluations.jsonl") if row["seed"] == seed]
    numbers = {
        (row["steps"], k): x
        for row in rows
        for k, x in row.items()
        if k not in ("steps", "seed") and x is not None
    }
    return numbers | {
        (row["steps"], f"evaluation/{k}"): row[k]
        for row in looks
        for k in ("return_mean", "return_std")
    }


def check(name, run_dir, seed, but=()):
    """The viewer has each number once, as the run has it: but for those in `but`, and in TensorBoard as a float32."""
    found, ours = READ[name](run_dir, seed), written(run_dir, seed)
    assert Counter((step, key) for step, key, _ in found) == Counter(ours.keys())
    kind = np.float32 if name == "tensorboard" else float
    assert {(s, k): x for s, k, x in found if k not in but} == {
        (s, k): float(kind(x)) for (s, k), x in ours.items() if k not in but
    }


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A run of two seeds that feeds nobody."""
    run_dir = tmp_path_factory.mktemp("runs") / "plain"
    assert (
        training.train_command(small(seeds=SEEDS), dataclasses.replace(QUIET, run_dir=run_dir)) == 0
    )
    return run_dir


@pytest.fixture(scope="module")
def fed(tmp_path_factory):
    """The same run, which feeds all that are installed."""
    run_dir, names = tmp_path_factory.mktemp("runs") / "fed", tuple(filter(present, METRIC_LOGGERS))
    with pytest.MonkeyPatch.context() as patch:
        for name in ("WANDB_MODE", "WANDB_API_KEY", "MLFLOW_TRACKING_URI"):
            patch.delenv(name, raising=False)
        patch.setenv("NETRC", str(run_dir.parent / "none"))
        assert (
            training.train_command(
                small(seeds=SEEDS), dataclasses.replace(QUIET, run_dir=run_dir, log=names)
            )
            == 0
        )
    return run_dir


@pytest.mark.parametrize("name", READABLE)
def test_a_viewer_has_every_number_of_the_run_once(name, fed):
    for seed in range(SEEDS):
        check(name, fed, seed)


def test_who_is_fed_changes_no_bit(plain, fed):
    assert last(fed).read_bytes() == last(plain).read_bytes()
    assert timeless(fed) == timeless(plain)
    assert (fed / "evaluations.jsonl").read_bytes() == (plain / "evaluations.jsonl").read_bytes()
    assert not (plain / "sinks.json").exists()


@pytest.mark.parametrize("name", READABLE)
def test_a_resumed_run_has_each_step_once_in_its_viewers(name, fed, tmp_path):
    run_dir, config = tmp_path / "half", small(seeds=SEEDS)
    stopped_half_way(fed, run_dir)
    assert directory.saved_options(run_dir).log == tuple(filter(present, METRIC_LOGGERS))
    assert (
        training.train_command(config, dataclasses.replace(QUIET, resume=run_dir, log=(name,))) == 0
    )
    there_already = (
        () if loggers.KINDS[name].goes_back else ("seconds",)
    )  # else equal, of the iterations after the checkpoint
    for seed in range(SEEDS):
        check(name, run_dir, seed, but=there_already)


@pytest.mark.parametrize("name", READABLE)
def test_a_viewer_that_is_asked_for_later_gets_what_came_before(name, plain, tmp_path):
    run_dir, config = tmp_path / "half", small(seeds=SEEDS)
    stopped_half_way(plain, run_dir)
    assert (
        training.train_command(config, dataclasses.replace(QUIET, resume=run_dir, log=(name,))) == 0
    )
    for seed in range(SEEDS):
        check(name, run_dir, seed)


@needs("tensorboard")
def test_tensorboard_has_the_configuration_and_the_curve(fed):
    values = {v.tag: v for event in events(fed, 1) for v in event.summary.value}
    assert (
        "| policy.clip_eps | 0.2 |"
        in values["configuration/text_summary"].tensor.string_val[0].decode()
    )
    assert "| seed | 1 |" in values["configuration/text_summary"].tensor.string_val[0].decode()
    assert values["curve.png"].image.encoded_image_string == (fed / "curve.png").read_bytes()
    assert (values["curve.png"].image.width, values["curve.png"].image.height) == (960, 600)


@needs("mlflow")
def test_mlflow_has_the_configuration_the_curve_and_how_it_ended(fed):
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{fed / 'mlflow' / 'mlflow.db'}")
    found = client.search_runs([client.get_experiment_by_name("dgae_jax").experiment_id])
    assert sorted(run.info.run_name for run in found) == ["fed-seed-0", "fed-seed-1"]
    for run in found:
        assert run.data.params["policy.clip_eps"] == "0.2"
        assert run.data.params["seed"] == run.info.run_name[-1]
        assert run.info.status == "FINISHED"
        assert {file.path for file in client.list_artifacts(run.info.run_id)} == {
            "config.json",
            "curve.png",
        }
    assert len(list((fed / "mlflow" / "files").rglob("curve.png"))) == SEEDS


@needs("wandb")
def test_weights_and_biases_stays_offline_where_nobody_is_logged_in_and_keeps_its_files_in_the_run(
    fed,
):
    assert len(list(fed.glob("wandb/offline-run-*"))) == SEEDS
    assert list(fed.glob("wandb/offline-run-*/files/media/images/*.png"))


def failing(calls, at):
    """A sink whose `at` breaks."""

    def begin(place):
        def taken(name):
            def take(*_):
                calls.append(name)
                if name == at:
                    raise ConnectionError("the network is gone\nmore")

            return take

        if at == "begin":
            taken("begin")()
        return MetricLogger(taken("rows"), taken("evaluations"), taken("close"))

    return begin


@pytest.mark.parametrize("at", ["begin", "rows", "evaluations", "close"])
def test_a_sink_that_fails_costs_one_warning_and_the_run_ends_as_it_would(
    at, plain, tmp_path, capsys, monkeypatch
):
    run_dir, calls = tmp_path / "run", []
    monkeypatch.setitem(
        loggers.KINDS, "tensorboard", loggers.Kind(failing(calls, at), goes_back=True)
    )
    assert (
        training.train_command(
            small(seeds=SEEDS), dataclasses.replace(QUIET, run_dir=run_dir, log=("tensorboard",))
        )
        == 0
    )
    assert calls.count(at) == 1
    assert calls[-1] == at
    rest = "the training goes on, and --resume adds what is missing"
    assert (
        capsys.readouterr().err
        == f"warning: --log tensorboard stops here (ConnectionError: the network is gone); {rest}\n"
    )
    assert last(run_dir).read_bytes() == last(plain).read_bytes()


@needs("tensorboard")
def test_a_viewer_that_failed_gets_what_it_lacks_when_the_run_is_resumed(
    tmp_path, capsys, monkeypatch
):
    run_dir, config = tmp_path / "run", small(seeds=SEEDS)
    with monkeypatch.context() as patch:
        patch.setitem(
            loggers.KINDS, "tensorboard", loggers.Kind(failing([], "rows"), goes_back=True)
        )
        assert (
            training.train_command(
                config, dataclasses.replace(QUIET, run_dir=run_dir, log=("tensorboard",))
            )
            == 0
        )
    assert not (run_dir / "tensorboard").exists()
    longer = dataclasses.replace(config, total_steps=10 * SMALL.samples_per_iteration)
    assert (
        training.train_command(
            longer, dataclasses.replace(QUIET, resume=run_dir, log=("tensorboard",))
        )
        == 0
    )
    check("tensorboard", run_dir, 0)


@pytest.mark.parametrize(
    "data",
    [
        "",
        "[]",
        "{",
        '{"tensorboard": 3}',
        '{"tensorboard": {"ids": [1], "rows": "many", "evaluations": -1}}',
    ],
)
def test_how_far_a_viewer_has_come_may_be_any_file_and_then_says_nothing(data, tmp_path):
    (tmp_path / "sinks.json").write_text(data)
    assert all(
        noted == {"ids": {}, "rows": 0, "evaluations": 0}
        for noted in loggers._read(tmp_path / "sinks.json").values()
    )


@pytest.mark.parametrize(
    ("log", "message"),
    [
        (("visdom",), "log visdom: must be one or more of tensorboard, wandb, mlflow"),
        (("tensorboard", "tensorboard"), "log tensorboard tensorboard: must be each viewer once"),
    ],
)
def test_a_viewer_that_is_unknown_or_named_twice_is_refused(log, message):
    with pytest.raises(ConfigError, match=message):
        validate_options(RunOptions(log=log), SMALL)


@pytest.mark.parametrize("name", METRIC_LOGGERS)
def test_a_missing_library_is_refused_with_what_to_install(name, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(
        ConfigError,
        match=rf'log {name}: {METRIC_LOGGERS[name]} is missing; pip install "dgae_jax\[{name}\]"',
    ):
        validate_options(RunOptions(log=(name,)), SMALL)


def test_a_folder_of_its_name_is_not_a_library(tmp_path, monkeypatch):
    (tmp_path / "a_viewer_s_folder").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(METRIC_LOGGERS, "wandb", "a_viewer_s_folder")
    with pytest.raises(ConfigError, match="a_viewer_s_folder is missing"):
        validate_options(RunOptions(log=("wandb",)), SMALL)


def test_a_run_goes_on_with_its_viewers_and_a_list_is_as_good_as_a_tuple(run_dir):
    directory.extend_manifest(run_dir, RunOptions(log=["tensorboard"]))
    assert directory.saved_options(run_dir) == RunOptions(log=("tensorboard",))
    text = (run_dir / "manifest.json").read_text()
    (run_dir / "manifest.json").write_text(text.replace('"tensorboard"', '{"no": "viewer"}'))
    assert directory.saved_options(run_dir).log == ()
