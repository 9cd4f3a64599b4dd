"""A film for each task of a study, for its report."""

import subprocess
import sys
from pathlib import Path

import numpy as np

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.envs.registry import spec_of
from dgae_jax.report.results import Row, Sweep
from dgae_jax.run import terminal

SECONDS = "8"
"""Longest part of an episode that is shown [s]."""


def typical(rows: list[Row]) -> Row:
    """Of the algorithm with the highest mean return the seed in the middle, the better of two."""
    algo = max(
        sorted({row.algo for row in rows}),
        key=lambda algo: np.mean([row.final for row in rows if row.algo == algo]),
    )
    ordered = sorted((row for row in rows if row.algo == algo), key=lambda row: row.final)
    return ordered[len(ordered) // 2]


def make(study: Sweep) -> list[Path]:
    """Films of the typical run of each task, where there is none yet; raises ConfigError if one cannot be made."""
    written = []
    for task in dict.fromkeys(row.task for row in study.rows):
        rows = [row for row in study.rows if row.task == task]
        stem = study.directory / "videos" / task.replace(":", "-")
        if stem.with_name(f"{stem.name}.mp4").exists() or not spec_of(rows[0].env).eval_envs:
            continue
        chosen = typical(rows)
        run_dir = study.directory / "runs" / chosen.run
        if not run_dir.is_dir():
            raise invalid("videos", True, f"left out: the runs of {study.path} are not here")
        stem.parent.mkdir(exist_ok=True)
        index = chosen.seed - int(chosen.config["seed"])
        words = [
            str(run_dir),
            "--out",
            str(stem),
            "--format",
            "mp4",
            "--seconds",
            SECONDS,
            "--index",
            str(index),
        ]
        terminal.say(f"filming {chosen.run}")
        # a process of its own: the OpenGL to draw with is chosen before MuJoCo is loaded
        done = subprocess.run(
            [sys.executable, "-m", "dgae_jax.cli.render", *words],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise ConfigError(
                f"videos: must be left out: {done.stderr.strip().removeprefix('error: ')}", "videos"
            )
        written.append(stem.with_name(f"{stem.name}.mp4"))
    return written
