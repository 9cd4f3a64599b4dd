"""`results.jsonl`: the results of a sweep, a row per trained seed, and the final policies."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import digest, to_dict
from dgae_jax.run import checkpoint, files, metrics
from dgae_jax.study.sweep import RunSpec, Sweep

MAX_POINTS = 200
"""Most points of a learning curve."""

Rows = list[dict[str, Any]]


def is_done(sweep: Sweep, run: RunSpec) -> bool:
    """Return whether the run has reached its end."""
    return (sweep.run_dir(run) / "evaluation.json").is_file()


def read(sweep: Sweep) -> dict[str, Rows]:
    """Return the rows of the runs that are done, by name.

    A run keeps its rows if its directory is on another machine.
    """
    path = sweep.path / "results.jsonl"
    before: dict[str, Rows] = {}
    for row in metrics.read(path) if path.is_file() else []:
        before.setdefault(row.get("cell", ""), []).append(row)
    found = {}
    for run in sweep.runs:
        if is_done(sweep, run):
            found[run.name] = rows_of(sweep, run)
        elif run.name in before and not sweep.run_dir(run).exists():
            found[run.name] = before[run.name]
    return found


def write(sweep: Sweep, rows: dict[str, Rows]) -> None:
    """Write the rows of the runs that are done, in the order of the sweep."""
    ordered = (row for run in sweep.runs for row in rows.get(run.name, []))
    files.replace(sweep.path / "results.jsonl", files.json_lines(ordered))


def rows_of(sweep: Sweep, run: RunSpec) -> Rows:
    """Return a row per seed of a run that is done, and write its policy."""
    run_dir, config = sweep.run_dir(run), run.config
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
                "cell": run.name,
                "env": config.env,
                "env_version": config.env_version,
                "algo": config.algo,
                "physics": config.physics,
                "variant": None if run.label == config.algo else run.label,
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
                "command": sweep.commands.get(run.name),
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
