"""`results.jsonl`: what came of the cells that are done, a row per trained seed, and their policies in files of their own."""

import dataclasses
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.configs.serial import to_dict
from dgae_jax.run import files, metrics
from dgae_jax.study.matrix import Cell, Study

POINTS = 200
"""Most points of a learning curve."""


def is_done(study: Study, cell: Cell) -> bool:
    """Whether the cell's run reached its end."""
    return (study.run_dir(cell) / "evaluation.json").is_file()


def of_study(study: Study) -> dict[str, list[dict[str, Any]]]:
    """The rows of all cells that are done, by their names; of cells whose run directory is elsewhere those that were written before."""
    path, before = study.path / "results.jsonl", {}
    for row in metrics.read(path) if path.is_file() else []:
        before.setdefault(row.get("cell"), []).append(row)
    found = {}
    for cell in study.cells:
        if is_done(study, cell):
            found[cell.name] = rows_of(study, cell)
        elif cell.name in before and not study.run_dir(cell).exists():
            found[cell.name] = before[cell.name]
    return found


def rows_of(study: Study, cell: Cell) -> list[dict[str, Any]]:
    """A row per seed of a cell that is done; its policy is written too."""
    run_dir, config = study.run_dir(cell), cell.config
    _keep_policy(run_dir, config, study.policy(cell))
    final, manifest = (
        json.loads((run_dir / name).read_bytes()) for name in ("evaluation.json", "manifest.json")
    )
    trained, evaluated = (
        metrics.read(run_dir / "metrics.jsonl"),
        metrics.EvaluationsFile(run_dir / "evaluations.jsonl").rows,
    )
    head = {
        "cell": cell.name,
        **{name: getattr(config, name) for name in ("env", "env_version", "algo", "physics")},
        "variant": None if cell.kind == config.algo else cell.kind,
    }
    tail = {
        "seconds": trained[-1]["seconds"],
        "samples_per_second": round(
            config.num_seeds * trained[-1]["steps"] / trained[-1]["seconds"], 1
        ),
        "policy": str(study.policy(cell).relative_to(study.path)),
        "config": to_dict(config),
        "versions": manifest["versions"],
        "machine": {name: manifest[name] for name in ("device", "cores")},
        "git_revision": manifest["git_revision"],
        "command": study.commands.get(cell.name),
    }
    return [
        {
            **head,
            "seed": one["seed"],
            "total_steps": config.total_steps,
            "steps": trained[-1]["steps"],
            "hash": digest(config),
            "final": {name: final[name] for name in ("engine", "env")}
            | {"episodes": len(one["returns"])}
            | _returns(one),
            "best": _best([row for row in evaluated if row["seed"] == one["seed"]]),
            "curve": _curve([row for row in trained if row["seed"] == one["seed"]]),
            "evaluations": {
                name: [row[name] for row in evaluated if row["seed"] == one["seed"]]
                for name in ("steps", "return_mean")
            },
            **tail,
        }
        for one in final["seeds"]
    ]


def write(study: Study, rows: dict[str, list[dict[str, Any]]]) -> None:
    """The rows of all cells that are done, in the order of the study."""
    files.replace(
        study.path / "results.jsonl",
        files.json_lines(row for cell in study.cells for row in rows.get(cell.name, [])),
    )


def digest(config: ResolvedConfig) -> str:
    """The same for configurations that differ in nothing but their seeds."""
    plain = json.dumps(to_dict(dataclasses.replace(config, seed=0, num_seeds=1)), sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:12]


def _returns(evaluation: dict[str, Any]) -> dict[str, Any]:
    return {name: evaluation.get(name) for name in ("return_mean", "return_std", "returns")}


def _best(evaluated: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The later of equal ones."""
    best = max(evaluated, key=lambda row: (row["return_mean"], row["steps"]), default=None)
    return best and {"steps": best["steps"], **_returns(best)}


def _curve(rows: list[dict[str, Any]]) -> dict[str, list]:
    """Means of the episode return over `POINTS` stretches of equal length, at the end of each; null where no episode has ended yet."""
    steps = np.array([row["steps"] for row in rows])
    returns = np.array(
        [math.nan if row["episode_return"] is None else row["episode_return"] for row in rows]
    )
    parts = [part for part in np.array_split(np.arange(len(rows)), POINTS) if len(part)]
    means = [returns[part][np.isfinite(returns[part])] for part in parts]
    return {
        "steps": [int(steps[part[-1]]) for part in parts],
        "return": [round(float(found.mean()), 3) if len(found) else None for found in means],
    }


def _keep_policy(run_dir: Path, config: ResolvedConfig, path: Path) -> None:
    """Write it unless it is there already, from this run: a cell that is trained again has a new one."""
    if not path.is_file() or path.stat().st_mtime < (run_dir / "evaluation.json").stat().st_mtime:
        from dgae_jax.run import checkpoint

        found = checkpoint.load_networks(run_dir, config, "latest")
        checkpoint.save_networks(path, config, found, checkpoint.reward_std(found.path, config))
