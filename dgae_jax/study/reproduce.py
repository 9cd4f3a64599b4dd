"""Train a sweep: launch the runs that are not done, show their progress, keep their results."""

import contextlib
import dataclasses
import json
import os
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import digest, to_dict
from dgae_jax.run import checkpoint, files, metrics, terminal
from dgae_jax.run.options import RunOptions
from dgae_jax.run.runtime import Signals
from dgae_jax.study.launch import Launch
from dgae_jax.study.sweep import Runs, Sweep, label_of
from dgae_jax.study.worker import Job, train_run

POLL = 0.5
"""Time between looks at the tasks [s]."""

MAX_POINTS = 200
"""Most points of a learning curve in the results."""

Rows = list[dict[str, Any]]
"""Rows of `results.jsonl`, one per seed."""


def reproduce(sweep: Sweep, asked: Runs, options: RunOptions, launch: Launch) -> int:
    """Train the runs that are not done, and keep `results.jsonl` up to date.

    Args:
        sweep: the sweep, opened by this process.
        asked: those of its runs that are asked for.
        options: options of every run.
        launch: the launcher.

    Returns:
        The exit code: 0 all are done, 1 some failed, 128 + a signal that came.

    Raises:
        ConfigError: the launcher cannot start.
    """
    jax.config.update("jax_platforms", "cpu")  # accelerators are left to the runs
    rows = read_results(sweep)
    write_results(sweep, rows)
    missing = {run: config for run, config in asked.items() if run not in rows}
    jobs = [_job(sweep, run, options) for run in missing]
    left = f", {len(jobs)} to train" if jobs else ""
    terminal.say(f"{sweep.path}: {len(asked) - len(jobs)} of {len(asked)} runs are done{left}")
    total = sum(c.iterations * c.samples_per_iteration * c.num_seeds for c in missing.values())
    began, before, failed = time.monotonic(), _steps(sweep, missing), []
    with (
        Signals() as signals,
        terminal.Reporter() as reporter,
        launch(jobs) if jobs else contextlib.nullcontext({}) as tasks,
    ):
        waiting = dict(tasks)
        while waiting and not signals.received:
            for task in [task for task in waiting if task.done()]:
                run = waiting.pop(task).name
                if reason := _failure(sweep, run, task):
                    failed.append(run)
                    terminal.say(f"{run}: {reason}")
                    continue
                rows[run] = rows_of(sweep, run)
                write_results(sweep, rows)
                terminal.say(_summary(run, rows[run]))
            steps = _steps(sweep, missing)
            speed = (steps - before) / (time.monotonic() - began)
            left = terminal.clock((total - steps) / speed) if speed else "unknown"
            runs_done = f"{len(jobs) - len(waiting)} of {len(jobs)} runs, {len(failed)} failed"
            reporter.watch(f"{runs_done}; {steps:,} of {total:,} steps, time left {left}")
            time.sleep(POLL)
        if waiting:
            terminal.say(f"stopping {len(waiting)} runs")
    if signals.received:
        terminal.say(f"stopped by {signals.received.name}; the same command continues")
        return 128 + signals.received
    for run in failed:
        terminal.warn(f"failed: {run}, see {sweep.log(run)}")
    return 1 if failed else 0


def _job(sweep: Sweep, run: str, options: RunOptions) -> Job:
    where = {"run_dir": sweep.run_dir(run).absolute(), "resume_or_start": True}
    args = sweep.runs[run], dataclasses.replace(options, num_processes=1, **where)
    return Job(run, train_run, args, sweep.log(run).absolute())


def _failure(sweep: Sweep, run: str, task: Any) -> str | None:
    """Return why a run has no result, by the last line of its log."""
    try:
        code = task.result()
    except Exception as reason:  # of whatever kind the launcher's library raises
        return f"{type(reason).__name__}: {str(reason).partition(chr(10))[0][:200]}"
    if code == 0 and is_done(sweep, run):
        return None
    log = sweep.log(run)
    lines = log.read_text(errors="replace").strip().splitlines() if log.is_file() else []
    return f"ended with exit code {code}: {lines[-1][:300] if lines else 'no output'}"


def _summary(run: str, rows: Rows) -> str:
    means = [row["final"]["return_mean"] for row in rows]
    shown = " ".join("not finite" if mean is None else f"{mean:,.1f}" for mean in means)
    return f"{run}: return {shown}, {rows[0]['samples_per_second']:,.0f} steps/s"


def _steps(sweep: Sweep, runs: Runs) -> int:
    return sum(reached(sweep, run) * config.num_seeds for run, config in runs.items())


def reached(sweep: Sweep, run: str) -> int:
    """Return the steps in the last whole row of the metrics of a run."""
    try:
        with (sweep.run_dir(run) / "metrics.jsonl").open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 16_384))  # a row is shorter
            return json.loads(file.read().rpartition(b"\n")[0].rpartition(b"\n")[2])["steps"]
    except (OSError, ValueError, LookupError, TypeError):
        return 0


def is_done(sweep: Sweep, run: str) -> bool:
    """Return whether the run has reached its end."""
    return (sweep.run_dir(run) / "evaluation.json").is_file()


def read_results(sweep: Sweep) -> dict[str, Rows]:
    """Return the rows of the runs that are done, by name.

    A run keeps its rows if its directory is on another machine.
    """
    path = sweep.path / "results.jsonl"
    found: dict[str, Rows] = {}
    for row in metrics.read(path) if path.is_file() else []:
        run = row.get("cell", "")
        if run in sweep.runs and not sweep.run_dir(run).exists():
            found.setdefault(run, []).append(row)
    return found | {run: rows_of(sweep, run) for run in sweep.runs if is_done(sweep, run)}


def write_results(sweep: Sweep, rows: dict[str, Rows]) -> None:
    """Write the rows of the runs that are done, in the order of the sweep."""
    ordered = (row for run in sweep.runs for row in rows.get(run, []))
    files.replace(sweep.path / "results.jsonl", files.json_lines(ordered))


def rows_of(sweep: Sweep, run: str) -> Rows:
    """Return a row per seed of a run that is done, and write its policy."""
    run_dir, config, label = sweep.run_dir(run), sweep.runs[run], label_of(run, sweep.runs[run])
    _write_policy(run_dir, config, sweep.policy(run))
    final = json.loads((run_dir / "evaluation.json").read_bytes())
    manifest = json.loads((run_dir / "manifest.json").read_bytes())
    trained = metrics.read(run_dir / "metrics.jsonl")
    evaluated = metrics.EvaluationsFile(run_dir / "evaluations.jsonl").rows
    steps, seconds = trained[-1]["steps"], trained[-1]["seconds"]
    rows = []
    for one in final["seeds"]:
        evaluations = [row for row in evaluated if row["seed"] == one["seed"]]
        rows.append(
            {
                "cell": run,
                "env": config.env,
                "env_version": config.env_version,
                "algo": config.algo,
                "physics": config.physics,
                "variant": None if label == config.algo else label,
                "seed": one["seed"],
                "total_steps": config.total_steps,
                "steps": steps,
                "hash": digest(config),
                "final": {
                    "engine": final["engine"],
                    "env": final["env"],
                    "episodes": len(one["returns"]),
                    **_returns(one),
                },
                "best": _best(evaluations),
                "curve": _curve([row for row in trained if row["seed"] == one["seed"]]),
                "evaluations": {
                    name: [row[name] for row in evaluations] for name in ("steps", "return_mean")
                },
                "seconds": seconds,
                "samples_per_second": round(config.num_seeds * steps / seconds, 1),
                "policy": str(sweep.policy(run).relative_to(sweep.path)),
                "config": to_dict(config),
                "versions": manifest["versions"],
                "machine": {name: manifest[name] for name in ("device", "cores")},
                "git_revision": manifest["git_revision"],
                "command": sweep.commands.get(run),
            }
        )
    return rows


def _returns(evaluation: dict[str, Any]) -> dict[str, Any]:
    return {name: evaluation.get(name) for name in ("return_mean", "return_std", "returns")}


def _best(evaluations: Rows) -> dict[str, Any] | None:
    """Return the best evaluation, the later of equal ones."""
    best = max(evaluations, key=lambda row: (row["return_mean"], row["steps"]), default=None)
    return best and {"steps": best["steps"], **_returns(best)}


def _curve(rows: Rows) -> dict[str, list]:
    """Average episode returns over equal stretches; null where no episode has ended yet."""
    steps = [row["steps"] for row in rows]
    returns = np.array([row["episode_return"] for row in rows], float)
    parts = [part for part in np.array_split(np.arange(len(rows)), MAX_POINTS) if len(part)]
    means = [returns[part][np.isfinite(returns[part])] for part in parts]
    return {
        "steps": [steps[part[-1]] for part in parts],
        "return": [round(float(found.mean()), 3) if len(found) else None for found in means],
    }


def _write_policy(run_dir: Path, config: ResolvedConfig, path: Path) -> None:
    """Write the final policy unless the file is newer than the end of the run."""
    if path.is_file() and path.stat().st_mtime >= (run_dir / "evaluation.json").stat().st_mtime:
        return
    found = checkpoint.load_networks(run_dir, config, "latest")
    checkpoint.save_networks(path, config, found, checkpoint.reward_std(found.path, config))
