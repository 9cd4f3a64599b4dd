"""Nothing is lost on the way: runs that are stopped, killed, damaged or broken."""

import dataclasses
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax.numpy as jnp
import pytest

import dgae_jax as dg
from dgae_jax.config import ConfigError
from dgae_jax.io import checkpoint, metrics, run_directory
from dgae_jax.io.training import RunOptions, resume, train
from tests.test_experiments import ROOT, TINY
from tests.test_train import SMALL

ITERATIONS = 8
QUIET = RunOptions(
    cache_dir=str(Path(tempfile.gettempdir()) / "dgae_jax_tests"), episodes=1, checkpoint_every=ITERATIONS // 2 * SMALL.samples
)


def small(algo, physics="native"):
    policy = dg.PolicyConfig(hidden=(8,)) if "trpo" in algo else SMALL.policy
    critic = SMALL.critic if algo[0] == "d" else dataclasses.replace(SMALL.critic, quantiles=64)
    steps = ITERATIONS * SMALL.samples
    return dataclasses.replace(SMALL, algo=algo, physics=physics, total_steps=steps, episode_length=20, policy=policy, critic=critic)


def timeless(run_dir):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in metrics.read(run_dir / "metrics.jsonl")]


def last(run_dir):
    return max((run_dir / "checkpoints").iterdir())


def stopped_half_way(whole, half):
    """A copy of a finished run as a crash after its first checkpoint would have left it, a torn line included."""
    shutil.copytree(whole, half)
    last(half).unlink()
    (half / "evaluation.json").unlink()
    with (half / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 9, "ste')


slow = pytest.mark.slow


@pytest.mark.parametrize(
    ("algo", "physics"),
    [
        ("dtrpo", "native"),
        *(pytest.param(algo, "native", marks=slow) for algo in ("ppo", "dppo", "trpo", "a2c", "da2c")),
        pytest.param("dppo", "mjx", marks=slow),
    ],
)
def test_a_run_that_stopped_half_way_ends_with_the_same_bits_and_the_same_metrics(algo, physics, tmp_path):
    whole, half, config = tmp_path / "whole", tmp_path / "half", small(algo, physics)
    assert train(config, dataclasses.replace(QUIET, run_dir=whole)) == 0
    stopped_half_way(whole, half)
    assert resume(config, dataclasses.replace(QUIET, resume=half)) == 0
    assert last(half).read_bytes() == last(whole).read_bytes()
    assert timeless(half) == timeless(whole)
    evaluations = [json.loads((d / "evaluation.json").read_text()) for d in (whole, half)]
    assert evaluations[0] == evaluations[1]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / "finished"
    train(small("ppo"), dataclasses.replace(QUIET, run_dir=run_dir))
    return run_dir


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gamma": 0.5}, "--gamma 0.5: must be 0.99 as in"),
        ({"env": "ant"}, "--env ant: must be hopper as in"),
        ({"algo": "a2c"}, "--algo a2c: must be ppo as in"),
        ({"physics": "mjx"}, "--physics mjx: must be native as in"),
        ({"policy": dataclasses.replace(SMALL.policy, clip=0.3)}, r"--policy\.clip 0\.3: must be 0\.2 as in"),
    ],
)
def test_a_changed_setting_is_refused_with_both_values(change, message, finished):
    with pytest.raises(ConfigError, match=message):
        resume(dataclasses.replace(small("ppo"), **change), dataclasses.replace(QUIET, resume=finished))


def test_a_finished_run_may_be_given_a_larger_budget(finished, tmp_path):
    longer = tmp_path / "longer"
    shutil.copytree(finished, longer)
    config = dataclasses.replace(small("ppo"), total_steps=10 * SMALL.samples)
    assert resume(config, dataclasses.replace(QUIET, resume=longer)) == 0
    assert [row["iteration"] for row in metrics.read(longer / "metrics.jsonl")] == list(range(1, 11))
    assert run_directory.read_config(longer).total_steps == config.total_steps


def test_a_directory_in_use_is_refused_and_left_alone(finished):
    with run_directory.locked(finished), pytest.raises(ConfigError, match="another process is training there"):
        resume(small("ppo"), dataclasses.replace(QUIET, resume=finished))


def test_updates_that_are_not_finite_are_left_out_and_counted_and_end_the_run_when_there_is_no_other(tmp_path, capsys):
    broken = dataclasses.replace(small("ppo"), policy=dataclasses.replace(SMALL.policy, learning_rate=1e30, max_grad_norm=1e30))
    options = dataclasses.replace(QUIET, run_dir=tmp_path / "run", max_nonfinite=3)
    assert train(broken, options) == 1
    assert "updates were not finite and were left out" in capsys.readouterr().err
    rows = metrics.read(tmp_path / "run" / "metrics.jsonl")
    assert sum(row["skipped"] for row in rows) >= 3
    state, _, _ = checkpoint.newest(tmp_path / "run", run_directory.read_config(tmp_path / "run"))
    assert all(jnp.isfinite(x).all() for fit in (state.policy, state.critic) for x in fit.params["params"]["Dense_0"].values())
    assert not (tmp_path / "run" / "evaluation.json").exists()


def start(run_dir, *more):
    """The real command on a run of 40 iterations with a checkpoint after each fifth, new or resumed."""
    if (run_dir / "config.json").exists():
        argv = ["--resume", str(run_dir)]
    else:
        argv = ["--run-dir", str(run_dir), "--total-steps", str(40 * 64), *TINY]
    argv += ["--checkpoint-every", str(5 * 64), "--episodes", "1", *more]
    return subprocess.Popen([sys.executable, "experiments/train.py", *argv], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@slow
def test_twenty_five_kills_at_random_moments_lose_nothing(tmp_path):
    whole, killed, chance = tmp_path / "whole", tmp_path / "killed", random.Random(0)
    since = time.monotonic()
    assert start(whole).wait() == 0
    usual = time.monotonic() - since
    kills = 0
    while kills < 25:
        process = start(killed)
        time.sleep(chance.uniform(0.3, 1.05) * usual)
        if process.poll() is None:
            process.kill()
            kills += 1
        process.wait()
        if (killed / "evaluation.json").exists():  # it got through: the next kills meet a run that begins again
            assert last(killed).read_bytes() == last(whole).read_bytes()
            shutil.rmtree(killed)
    assert start(killed).wait() == 0
    assert last(killed).read_bytes() == last(whole).read_bytes()
    assert timeless(killed) == timeless(whole)


@slow
@pytest.mark.parametrize(("kind", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_saves_within_half_a_minute_and_a_second_one_ends_at_once(kind, code, tmp_path):
    run_dir = tmp_path / "run"
    argv = ["--run-dir", str(run_dir), "--total-steps", "100_000_000", "--physics", "native", "--episodes", "1"]
    for signals in (1, 2):
        process = subprocess.Popen(
            [sys.executable, "experiments/train.py", *(argv if signals == 1 else ["--resume", str(run_dir)])], cwd=ROOT, text=True,
            stdout=subprocess.PIPE,
        )  # fmt: skip
        lines = len(metrics.read(run_dir / "metrics.jsonl")) if signals == 2 else 0
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and not (
            (run_dir / "metrics.jsonl").exists() and len((run_dir / "metrics.jsonl").read_text().splitlines()) > lines
        ):
            time.sleep(0.2)
        process.send_signal(kind)
        since = time.monotonic()
        if signals == 2:
            time.sleep(0.05)
            process.send_signal(kind)
        out, _ = process.communicate(timeout=60)
        assert time.monotonic() - since < 30
        assert process.returncode in ((code,) if signals == 1 else (code, -kind))
        if signals == 1:
            assert f"continue with --resume {run_dir}" in out
    state, _, _ = checkpoint.newest(run_dir, run_directory.read_config(run_dir))
    assert int(state.iteration[0]) >= 1


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes anywhere")
def test_a_directory_that_cannot_be_written_is_one_clear_line(finished):
    finished.chmod(0o500)
    try:
        with pytest.raises(ConfigError, match="must be a directory that can be written"):
            train(small("ppo"), dataclasses.replace(QUIET, run_dir=finished / "below"))
    finally:
        finished.chmod(0o700)


def test_the_public_way_to_a_preset_and_back_through_a_file_is_the_same_configuration(tmp_path):
    config = dg.preset("paper", "dtrpo", "ant")
    run_directory.write_json(tmp_path / "config.json", dataclasses.asdict(config))
    assert run_directory.read_config_file(tmp_path / "config.json") == config
