"""Hostile and broken input: one clear error, never a stack trace."""

import contextlib
import io
import json

import msgpack
import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import dgae_jax as dg
from dgae_jax.cli import parse
from dgae_jax.cli.train import parsed
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.configs.serial import from_dict, to_dict
from dgae_jax.run import checkpoint, files, metrics
from dgae_jax.run.checkpoint import CheckpointError
from tests.helpers import signed

SETTINGS = settings(
    max_examples=150, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True
)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=6,
)
CONFIG = to_dict(dg.Config())
FLAGS = ["--" + name.replace("_", "-") for name in CONFIG]
FLAGS += [f"--{part}.{name}" for part in ("policy", "critic", "noise") for name in CONFIG[part]]
FLAGS += [f"--{name}" for name in ("preset", "config", "run-dir", "resume", "inexact", "lr")]
VALUES = ["--", "-h2", "DTRPO", "Ant-v5", "brax:", "cvar:0.1", "nan", "-1", "1e400", "True", "None"]
WORDS = st.sampled_from(FLAGS + VALUES) | st.text(max_size=10)


@settings(SETTINGS, max_examples=40)
@given(st.lists(WORDS, min_size=1, max_size=6))
def test_any_command_line_is_understood_or_refused(words):
    err, code = io.StringIO(), 0
    with contextlib.redirect_stderr(err), contextlib.redirect_stdout(io.StringIO()):
        try:
            parse.Command(None, lambda _: parsed(words), lambda run: None)()
        except SystemExit as stop:
            code = stop.code
    assert code in (0, 2, None)
    assert bool(err.getvalue()) == (code == 2)


CHANGED = st.builds(lambda name, value: {**CONFIG, name: value}, st.sampled_from([*CONFIG]), PLAIN)


@SETTINGS
@given(PLAIN | CHANGED)
def test_any_json_is_a_configuration_or_refused(data):
    with contextlib.suppress(ConfigError):
        resolve(from_dict(data))


ROW = {"seed": 0, "seconds": 1.0, "episode_return": 1.5, "return_mean": 1, "return_std": 0}
ROWS = files.json_lines({"iteration": i, "steps": 10 * i, **ROW} for i in range(1, 6))


@SETTINGS
@given(st.integers(0, len(ROWS)), st.binary(max_size=30), st.integers(0, 99))
def test_any_tail_of_metrics_and_evaluations_is_cut_or_refused(tmp_path_factory, cut, tail, steps):
    path = tmp_path_factory.mktemp("rows") / "rows.jsonl"
    path.write_bytes(ROWS[:cut] + tail)
    file = metrics.EvaluationsFile(path)
    file.cut(steps, 1)
    assert metrics.EvaluationsFile(path).rows == file.rows
    assert file.best is None or file.best <= steps
    path.write_bytes(ROWS[:cut] + tail)
    with contextlib.suppress(ConfigError):
        assert metrics.MetricsFile(path, dg.Config(), 3).seconds == 1.0
        assert [row["iteration"] for row in metrics.read(path)] == [1, 2, 3]


ARRAY = msgpack.ExtType(1, msgpack.packb(((2,), "float32", bytes(8))))
BODY = msgpack.packb({"arrays": {"a": ARRAY, "b": True}, "config": json.dumps(CONFIG)})
FRONT = st.integers(0, 120)


@SETTINGS
@given(st.booleans(), FRONT, st.binary(max_size=60), FRONT | st.integers(0, len(BODY)))
def test_any_bytes_are_a_checkpoint_or_refused(tmp_path_factory, has_checksum, at, noise, rest):
    path = tmp_path_factory.mktemp("checkpoints") / "steps_000000000001.msgpack"
    body = BODY[:at] + noise + BODY[rest:]
    path.write_bytes(signed(body) if has_checksum else signed(BODY)[:at] + noise + BODY[rest:])
    with contextlib.suppress(CheckpointError):
        checkpoint.load(path, {"a": np.ones(2, np.float32)}, resolve(dg.Config()))
