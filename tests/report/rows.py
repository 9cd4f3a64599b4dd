"""Rows and directories in the form that a sweep writes, with numbers of a known shape."""

import json

import numpy as np

from dgae_jax.configs.presets import preset
from dgae_jax.configs.resolved import resolve
from dgae_jax.configs.serial import to_dict

ALGORITHMS = ("ppo", "dppo", "trpo", "dtrpo", "a2c", "da2c")


def row(env="hopper", algo="dppo", seed=0, run=None, **changes):
    """One row; `changes` replace what is in it."""
    config = json.loads(json.dumps(to_dict(resolve(preset("tuned", algo, env)))))
    generator = np.random.default_rng([seed, ALGORITHMS.index(algo), len(env)])
    height = 3000 * generator.normal(1, 0.15)
    steps = np.linspace(5_000, 999_424, 120).astype(int)
    curve = height * (1 - np.exp(-steps / 250_000)) + generator.normal(0, 60, len(steps))
    returns = generator.normal(height, 20, 20)
    final = {"engine": "gymnasium", "return_mean": returns.mean(), "returns": returns.tolist()}
    found = {
        "cell": run or f"{env}-{algo}-{seed}",
        "env": env,
        "env_version": config["env_version"],
        "algo": algo,
        "variant": None,
        "seed": seed,
        "total_steps": 1_000_000,
        "final": final,
        "best": {"steps": 800_000, "return_mean": height + 50},
        "curve": {"steps": steps.tolist(), "return": [None, *curve[1:].tolist()]},
        "seconds": 80.0 + seed,
        "samples_per_second": 12_000.0 + 100 * seed,
        "config": config | {"seed": seed},
        "versions": {"jax": "0.10.2", "mujoco": "4.0.0"},
        "machine": {"device": "cpu: x", "cores": 1},
        "git_revision": "0" * 40,
        "command": f"dgae train --env {env} --algo {algo} --seed {seed}",
    }
    return found | changes


def plain(scores, env="hopper", algo="dppo", **changes):
    """Rows with these final returns, one per seed."""
    return [
        row(env, algo, seed, **{"final": {"engine": "gymnasium", **final}} | changes)
        for seed, final in enumerate({"return_mean": x, "returns": [x]} for x in scores)
    ]


def study(directory, rows, planned=()):
    """Write the directory of a sweep with these rows; return its path."""
    directory.mkdir(parents=True, exist_ok=True)
    runs = {name: {} for name in [*(each["cell"] for each in rows), *planned]}
    (directory / "study.json").write_text(json.dumps({"schema": 1, "cells": runs}))
    (directory / "results.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))
    return directory


def whole(envs=("ant", "hopper", "swimmer", "walker2d"), algorithms=ALGORITHMS, seeds=5):
    """Rows of a complete sweep."""
    return [row(env, algo, seed) for env in envs for algo in algorithms for seed in range(seeds)]
