"""Nothing is lost on the way: runs that are stopped, killed, damaged or broken."""

import contextlib
import dataclasses
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path

import jax.numpy as jnp
import pytest

import dgae_jax as dg
from dgae_jax.configs.config import ConfigError
from dgae_jax.run import checkpoint, directory, files, loop, manifest, metrics
from dgae_jax.run import record as record_module
from dgae_jax.run.evaluation import evaluate_run
from dgae_jax.run.loop import resume, train
from dgae_jax.run.options import RunOptions
from dgae_jax.run.record import Record
from tests.helpers import ROOT, SMALL, TINY

ITERATIONS = 8
QUIET = RunOptions(
    cache_dir=str(Path(tempfile.gettempdir()) / "dgae_jax_tests"),
    episodes=1,
    checkpoint_every=ITERATIONS // 2 * 64,
)


@pytest.fixture(scope="module", autouse=True)
def _compiled_once():
    """Runs of the same configuration share their program, which JAX does not keep for `native`."""
    with pytest.MonkeyPatch.context() as patch:
        for make in (loop.make_task, loop.make_trainer):
            patch.setattr(loop, make.__name__, cache(make))
        yield


def small(algo, physics="native", seeds=1):
    policy = dg.PolicyConfig(hidden=(8,)) if "trpo" in algo else SMALL.policy
    critic = SMALL.critic if algo[0] == "d" else dataclasses.replace(SMALL.critic, quantiles=64)
    steps = ITERATIONS * SMALL.samples_per_iteration
    shape = {"total_steps": steps, "episode_length": 20, "num_seeds": seeds}
    return dataclasses.replace(SMALL, algo=algo, physics=physics, policy=policy, critic=critic, **shape)


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
    ("algo", "physics", "seeds"),
    [
        ("dtrpo", "native", 1),
        ("ppo", "native", 3),
        *(pytest.param(algo, "native", 1, marks=slow) for algo in ("ppo", "dppo", "trpo", "a2c", "da2c")),
        pytest.param("dppo", "jax", 1, marks=slow),
    ],
)
def test_a_run_that_stopped_half_way_ends_with_the_same_bits_and_the_same_metrics(algo, physics, seeds, tmp_path):
    whole, half, config = tmp_path / "whole", tmp_path / "half", small(algo, physics, seeds)
    assert train(config, dataclasses.replace(QUIET, run_dir=whole)) == 0
    stopped_half_way(whole, half)
    assert resume(config, dataclasses.replace(QUIET, resume=half)) == 0
    assert last(half).read_bytes() == last(whole).read_bytes()
    assert timeless(half) == timeless(whole)
    for name in ("evaluation.json", "evaluations.jsonl"):
        assert (half / name).read_bytes() == (whole / name).read_bytes()
    assert len(metrics.read(whole / "evaluations.jsonl")) == 2 * seeds


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
        ({"physics": "jax"}, "--physics jax: must be native as in"),
        ({"policy": dataclasses.replace(SMALL.policy, clip=0.3)}, r"--policy\.clip 0\.3: must be 0\.2 as in"),
    ],
)
def test_a_changed_setting_is_refused_with_both_values(change, message, finished):
    with pytest.raises(ConfigError, match=message):
        resume(dataclasses.replace(small("ppo"), **change), dataclasses.replace(QUIET, resume=finished))


def test_a_finished_run_may_be_given_a_larger_budget(finished, tmp_path):
    longer = tmp_path / "longer"
    shutil.copytree(finished, longer)
    config = dataclasses.replace(small("ppo"), total_steps=10 * SMALL.samples_per_iteration)
    assert resume(config, dataclasses.replace(QUIET, resume=longer)) == 0
    assert [row["iteration"] for row in metrics.read(longer / "metrics.jsonl")] == list(range(1, 11))
    assert directory.read_config(longer).total_steps == config.total_steps


@pytest.fixture
def run_dir(finished, tmp_path):
    """A copy of the finished run."""
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


def test_a_budget_below_what_is_done_is_refused(finished):
    config = dataclasses.replace(small("ppo"), total_steps=7 * 64)
    with pytest.raises(ConfigError, match="--total-steps 448: must be at least the 512 that are done"):
        resume(config, dataclasses.replace(QUIET, resume=finished))


def test_a_directory_in_use_is_refused_and_left_alone_also_while_its_configuration_is_rewritten(run_dir):
    with directory.locked(run_dir):
        directory.write_config(run_dir, directory.read_config(run_dir))
        with pytest.raises(ConfigError, match="another process is training there"):
            resume(small("ppo"), dataclasses.replace(QUIET, resume=run_dir))
    with directory.locked(run_dir):
        pass


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("cores",), 99),
        (("device",), "tpu: v9"),
        (("git_revision",), "abc"),
        (("versions", "jaxlib"), "0.0.1"),
        (("settings", "jax_enable_x64"), True),
    ],
)
def test_another_machine_or_version_is_refused_by_both_values_unless_asked_for_and_then_warned_of(path, value, run_dir, capsys):
    written = json.loads((run_dir / "manifest.json").read_text())
    (written if len(path) == 1 else written[path[0]])[path[-1]] = value
    files.write_json(run_dir / "manifest.json", written)
    with pytest.raises(ConfigError, match=rf"must go on where it began, or with --inexact; now {path[-1]} .* \(was {value}\)"):
        resume(small("ppo"), dataclasses.replace(QUIET, resume=run_dir))
    assert resume(small("ppo"), dataclasses.replace(QUIET, resume=run_dir, inexact=True)) == 0
    assert f"(was {value}): rounding differs, by up to 1e-6 relative" in capsys.readouterr().err
    assert resume(small("ppo"), dataclasses.replace(QUIET, resume=run_dir)) == 0  # where it was last


def test_physics_may_change_if_asked_for_with_a_warning_that_names_the_tolerance(run_dir, capsys):
    other = dataclasses.replace(small("ppo", "jax"), total_steps=9 * 64)
    assert resume(other, dataclasses.replace(QUIET, resume=run_dir, inexact=True)) == 0
    assert "warning: physics jax (was native): one step differs by up to 1e-4" in capsys.readouterr().err
    assert directory.read_config(run_dir).physics == "jax"


def test_the_best_checkpoint_stays_and_can_be_evaluated(tmp_path):
    config, run_dir = small("ppo"), tmp_path / "run"
    options = dataclasses.replace(QUIET, run_dir=run_dir, checkpoint_every=64, keep_checkpoints=1)
    scores = iter([1.0, 5.0, 3.0, 5.0, 2.0, 2.0, 2.0, 2.0])
    honest = record_module.evaluate_state

    def scored(state, config, **how):
        score = {"seed": 0, "return_mean": next(scores), "return_std": 0.0}
        return {**honest(state, config, **how), "seeds": [score]}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(record_module, "evaluate_state", scored)
        assert train(config, options) == 0
    assert [p.name for p in checkpoint.found(run_dir / "checkpoints")] == [f"steps_{steps:012d}.msgpack" for steps in (256, 512)]
    config = directory.read_config(run_dir)
    found = {which: evaluate_run(run_dir, config, which=which, engine="gymnasium", episodes=1) for which in ("best", "newest")}
    assert [found[which]["checkpoint"] for which in ("best", "newest")] == ["steps_000000000256.msgpack", "steps_000000000512.msgpack"]
    assert found["newest"]["returns"] == json.loads((run_dir / "evaluation.json").read_text())["returns"]


def test_the_best_checkpoint_of_a_run_without_evaluations_is_refused(run_dir):
    (run_dir / "evaluations.jsonl").unlink()
    with pytest.raises(ConfigError, match=r"--checkpoint best: must be newest: .* has no evaluations"):
        evaluate_run(run_dir, small("ppo"), which="best", engine="gymnasium", episodes=1)


@pytest.mark.parametrize("evaluation", [1, 2])
@pytest.mark.parametrize(("kind", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_in_an_evaluation_breaks_it_off_and_the_run_goes_on_later_to_the_same_end(
    kind, code, evaluation, finished, tmp_path, capsys
):
    run_dir, config, calls = tmp_path / "run", small("ppo"), []

    def interrupted(*args, **how):
        calls.append(how)
        if len(calls) == evaluation:
            signal.raise_signal(kind)
            pytest.fail("the evaluation went on")
        return honest(*args, **how)

    honest = record_module.evaluate_state
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(record_module, "evaluate_state", interrupted)
        assert train(config, dataclasses.replace(QUIET, run_dir=run_dir)) == code
    assert f"stopped by {kind.name}; continue with --resume {run_dir}" in capsys.readouterr().out
    assert len(calls) == evaluation
    assert not (run_dir / "evaluation.json").exists()
    assert resume(config, dataclasses.replace(QUIET, resume=run_dir)) == 0
    assert last(run_dir).read_bytes() == last(finished).read_bytes()
    assert timeless(run_dir) == timeless(finished)
    assert (run_dir / "evaluations.jsonl").read_bytes() == (finished / "evaluations.jsonl").read_bytes()


def test_a_directory_that_vanishes_while_it_trains_ends_the_run_in_one_line(tmp_path, capsys):
    run_dir, honest = tmp_path / "run", Record.append

    def append(record, *args):
        if record.steps == 64:  # no checkpoint yet, nothing on its way
            shutil.rmtree(run_dir)
        return honest(record, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Record, "append", append)
        assert train(small("ppo"), dataclasses.replace(QUIET, run_dir=run_dir)) == 1
    error = f"stopped: {run_dir}/metrics.jsonl: cannot be written (No such file or directory); there is no checkpoint\n"
    assert capsys.readouterr().err == error
    assert not run_dir.exists()


@contextlib.contextmanager
def no_file_larger_than(size):
    """The operating system refuses to write more, as on a full disk."""
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


@pytest.mark.parametrize(("name", "share"), [("checkpoints/steps_000000000256.msgpack", 0.9), ("curve.png", 1.1)])
def test_a_disk_that_takes_no_more_ends_the_run_in_one_line_and_it_goes_on_later_to_the_same_end(name, share, finished, tmp_path, capsys):
    run_dir, size = tmp_path / "run", last(finished).stat().st_size
    assert (finished / "metrics.jsonl").stat().st_size < 0.9 * size < 1.1 * size < (finished / "curve.png").stat().st_size
    with no_file_larger_than(int(share * size)):
        assert train(small("ppo"), dataclasses.replace(QUIET, run_dir=run_dir)) == 1
    left = f"continue from {last(run_dir).name} with --resume {run_dir}" if share > 1 else "there is no checkpoint"
    assert capsys.readouterr().err == f"stopped: {run_dir}/{name}: cannot be written (File too large); {left}\n"
    assert not list(run_dir.rglob("*.part"))
    assert resume(small("ppo"), dataclasses.replace(QUIET, resume=run_dir)) == 0
    assert last(run_dir).read_bytes() == last(finished).read_bytes()
    assert timeless(run_dir) == timeless(finished)


@contextlib.contextmanager
def without_rights(directory):
    """As somebody who may read the directory at most, also where the tests are run by root."""
    user = os.geteuid()
    directory.chmod(0o500)
    os.seteuid(user or 65534)
    try:
        yield
    finally:
        os.seteuid(user)
        directory.chmod(0o700)


def test_a_directory_that_cannot_be_written_is_one_clear_line(run_dir):
    with without_rights(run_dir), pytest.raises(ConfigError, match=r"must be a directory that can be written.*Permission denied"):
        train(small("ppo"), dataclasses.replace(QUIET, run_dir=run_dir / "below"))
    with without_rights(run_dir), pytest.raises(ConfigError, match="Permission denied"):
        resume(small("ppo"), dataclasses.replace(QUIET, resume=run_dir))


PARTS = ["config.json", "metrics.jsonl", "evaluations.jsonl", "checkpoints", "checkpoints/steps_000000000256.msgpack"]


@pytest.mark.parametrize("name", PARTS)
def test_a_run_directory_with_a_link_in_it_is_refused_and_nothing_is_touched(name, run_dir, tmp_path):
    (run_dir / name).rename(tmp_path / "outside")
    (run_dir / name).symlink_to(tmp_path / "outside")
    before = sorted((p, p.lstat().st_mtime_ns) for p in tmp_path.rglob("*"))
    with pytest.raises(ConfigError, match=rf"run/{name}: must be a (file|directory) in the run directory itself, not a link"):
        resume(directory.read_config(run_dir), dataclasses.replace(QUIET, resume=run_dir))
    assert sorted((p, p.lstat().st_mtime_ns) for p in tmp_path.rglob("*")) == before


def test_a_run_that_lost_its_checkpoints_is_refused_and_keeps_the_rest(run_dir):
    shutil.rmtree(run_dir / "checkpoints")
    before = timeless(run_dir)
    with pytest.raises(ConfigError, match=r"must hold a checkpoint; it had some when it was evaluated"):
        resume(small("ppo"), dataclasses.replace(QUIET, resume=run_dir))
    assert timeless(run_dir) == before


def test_a_run_that_is_refused_for_its_metrics_is_left_as_it_was(run_dir):
    rows = (run_dir / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run_dir / "metrics.jsonl").write_text("".join(rows[:3]))
    before = {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}
    with pytest.raises(ConfigError, match="must hold the 8 iterations"):
        resume(dataclasses.replace(small("ppo"), total_steps=9999), dataclasses.replace(QUIET, resume=run_dir))
    assert {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()} == before


def test_a_resumed_run_goes_on_with_its_options(run_dir):
    assert manifest.options(run_dir) == RunOptions(checkpoint_every=256, episodes=1)
    manifest.add(run_dir, RunOptions(keep_checkpoints=7, debug_nonfinite=True))
    assert manifest.options(run_dir) == RunOptions(keep_checkpoints=7, debug_nonfinite=True)


def test_a_pipe_in_place_of_a_file_is_refused_and_does_not_hang(run_dir):
    (run_dir / "config.json").unlink()
    os.mkfifo(run_dir / "config.json")
    with pytest.raises(ConfigError, match="not a link or anything else"):
        directory.read_config(run_dir)


@pytest.mark.parametrize("name", ["curve.png", "curve.png.part", "evaluation.json", "manifest.json.part"])
def test_links_where_whole_files_are_written_are_replaced_and_not_followed(name, run_dir, tmp_path):
    (tmp_path / "outside").write_text("mine")
    (run_dir / name).unlink(missing_ok=True)
    (run_dir / name).symlink_to(tmp_path / "outside")
    assert resume(small("ppo"), dataclasses.replace(QUIET, resume=run_dir)) == 0
    assert (tmp_path / "outside").read_text() == "mine"
    assert not (run_dir / name).is_symlink()


def test_updates_that_are_not_finite_are_left_out_and_counted_and_end_the_run_when_there_is_no_other(tmp_path, capsys):
    broken = dataclasses.replace(small("ppo"), policy=dataclasses.replace(SMALL.policy, learning_rate=1e30, max_grad_norm=1e30))
    options = dataclasses.replace(QUIET, run_dir=tmp_path / "run", max_nonfinite=3)
    assert train(broken, options) == 1
    assert "updates were not finite and were left out" in capsys.readouterr().err
    rows = metrics.read(tmp_path / "run" / "metrics.jsonl")
    assert sum(row["skipped"] for row in rows) >= 3
    state, _ = checkpoint.newest(tmp_path / "run", directory.read_config(tmp_path / "run"))
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
    state, _ = checkpoint.newest(run_dir, directory.read_config(run_dir))
    assert int(state.iteration[0]) >= 1


def test_the_public_way_to_a_preset_and_back_through_a_file_is_the_same_configuration(tmp_path):
    config = dg.preset("paper", "dtrpo", "ant")
    files.write_json(tmp_path / "config.json", dataclasses.asdict(config))
    assert directory.read_config_file(tmp_path / "config.json") == config
