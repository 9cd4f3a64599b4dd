"""Hostile and broken input: one clear error of ours, never a stack trace, a hang or code that runs."""

import contextlib
import io
import json

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import dgae_jax as dg
from dgae_jax.cli.parse import fail
from dgae_jax.cli.train import parsed
from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import resolve
from dgae_jax.configs.serial import from_dict, to_dict
from dgae_jax.run import checkpoint, directory, files, metrics
from dgae_jax.run.checkpoint import CheckpointError
from dgae_jax.run.metrics import EvaluationsFile
from dgae_jax.run.options import RunOptions
from tests.helpers import signed

many = settings(
    max_examples=600, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True
)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=6,
)
NAMES = (
    sorted(to_dict(dg.Config()))
    + sorted(to_dict(dg.Config())["policy"])
    + sorted(to_dict(dg.Config())["critic"])
)
FLAGS = ["--" + part + name.replace("_", "-") for name in NAMES for part in ("", "policy.", "critic.", "noise.")] + [
    "--preset", "--config", "--run-dir", "--resume", "--resume-or-start", "--episodes", "--checkpoint-every", "--keep-checkpoints",
    "--inexact", "--max-nonfinite", "--", "-h2", "--no-diagnostics",
]  # fmt: skip
WORDS = st.sampled_from(
    [
        *FLAGS,
        "ppo",
        "dtrpo",
        "hopper",
        "brax:ant",
        "brax:",
        "cvar:0.1",
        "nan",
        "inf",
        "-1",
        "1e400",
        "True",
    ]
)


@many
@given(st.lists(WORDS | st.text(max_size=10), min_size=1, max_size=6))
def test_any_command_line_is_understood_or_refused_in_one_line(words):
    err, out, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stderr(err), contextlib.redirect_stdout(out):
        try:
            parsed(words)  # all but the training itself
        except ConfigError as mistake:
            with pytest.raises(SystemExit) as stop:
                fail(mistake)
            code = stop.value.code
        except SystemExit as stop:
            code = stop.code
    assert code in (0, 2, None)
    if code == 2:
        lines = err.getvalue().splitlines()
        assert len(lines) == 1, lines
        assert lines[0].startswith("error: ")


def changed(data, path, value):
    copy = json.loads(json.dumps(data))
    at = copy
    for name in path[:-1]:
        at = at[name]
    at[path[-1]] = value
    return copy


PATHS = [(k,) for k in to_dict(dg.Config())] + [
    (p, k) for p in ("policy", "critic", "noise") for k in to_dict(dg.Config())[p]
]


@pytest.mark.parametrize("name", ["gamma", "total_steps", "seed"])
def test_a_number_of_four_hundred_digits_is_refused(name):
    with pytest.raises(ConfigError, match=name.replace("_", "[-_]")):
        resolve(from_dict({**to_dict(dg.Config()), name: 10**400}))


@many
@given(
    st.one_of(
        PLAIN,
        st.builds(
            lambda path, value: changed(to_dict(dg.Config()), path, value),
            st.sampled_from(PATHS),
            PLAIN,
        ),
    )
)
def test_any_json_is_a_configuration_or_refused(data):
    with contextlib.suppress(ConfigError):
        resolve(from_dict(data))


ROWS = files.json_lines(
    {
        "iteration": i,
        "steps": 10 * i,
        "seed": 0,
        "seconds": 1.0,
        "episode_return": 1.5,
        "return_mean": 1,
        "return_std": 0,
    }
    for i in range(1, 6)
)


@many
@given(st.integers(0, len(ROWS)), st.binary(max_size=30))
def test_any_tail_of_the_metrics_is_cut_or_refused(tmp_path_factory, cut, tail):
    path = tmp_path_factory.mktemp("metrics") / "metrics.jsonl"
    path.write_bytes(ROWS[:cut] + tail)
    try:
        file = metrics.MetricsFile(path, dg.Config(), 3)
    except ConfigError:
        return
    assert [row["iteration"] for row in metrics.read(path)] == [1, 2, 3]
    assert file.seconds == 1.0


@many
@given(st.integers(0, len(ROWS)), st.binary(max_size=30), st.integers(0, 99))
def test_any_bytes_are_evaluations_as_far_as_they_are_rows(tmp_path_factory, cut, tail, steps):
    path = tmp_path_factory.mktemp("evaluations") / "evaluations.jsonl"
    path.write_bytes(ROWS[:cut] + tail)
    file = EvaluationsFile(path)
    file.cut(steps, 1)
    assert EvaluationsFile(path).rows == file.rows
    assert file.best is None or file.best <= steps
    assert file.points().shape == (len(file.rows), 3)


MANIFEST = st.fixed_dictionaries(
    {},
    optional={
        "resumed": PLAIN | st.lists(PLAIN, max_size=2),
        "versions": PLAIN,
        "device": PLAIN,
        "cores": PLAIN,
    },
)


@many
@given(PLAIN | MANIFEST, st.binary(max_size=20))
def test_any_manifest_is_another_machine_and_can_be_added_to(tmp_path_factory, data, noise):
    run_dir = tmp_path_factory.mktemp("manifest")
    (run_dir / "manifest.json").write_bytes(json.dumps(data).encode() + noise)
    assert directory.environment_changes(run_dir, RunOptions())
    directory.extend_manifest(run_dir, directory.saved_options(run_dir))
    assert directory.environment_changes(run_dir, directory.saved_options(run_dir)) == []


BODY = msgpack.packb(
    {
        "arrays": {
            "a": msgpack.ExtType(checkpoint.ARRAY, msgpack.packb(((2,), "float32", bytes(8)))),
            "b": True,
        },
        "config": json.dumps(to_dict(dg.Config())),
    }
)
FRONT = st.integers(
    0, 120
)  # the arrays, the beginning of the configuration, and the header where there is one


@many
@given(st.booleans(), FRONT, st.binary(max_size=60), FRONT | st.integers(0, len(BODY)))
def test_any_bytes_are_a_checkpoint_or_refused_whether_they_carry_a_checksum_or_not(
    tmp_path_factory, honest, at, noise, rest
):
    path = tmp_path_factory.mktemp("checkpoints") / "steps_000000000001.msgpack"
    body = BODY[:at] + noise + BODY[rest:]
    path.write_bytes(signed(body) if honest else (signed(BODY)[:at] + noise + signed(BODY)[rest:]))
    with contextlib.suppress(CheckpointError):
        checkpoint.config_of(path)
    with contextlib.suppress(CheckpointError):
        checkpoint.load(path, {"a": np.ones(2, np.float32)})
