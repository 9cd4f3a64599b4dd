"""Studies that nobody trained: rows and directories in the form that a study writes, with numbers of a known shape."""

import json

import numpy as np

from dgae_jax.configs.presets import preset
from dgae_jax.configs.resolved import resolve
from dgae_jax.configs.serial import to_dict

ALGORITHMS = ("ppo", "dppo", "trpo", "dtrpo", "a2c", "da2c")
HEIGHT = {
    "ppo": 3000.0,
    "dppo": 3300.0,
    "trpo": 2400.0,
    "dtrpo": 2700.0,
    "a2c": 900.0,
    "da2c": 1000.0,
}


def row(env="hopper", algo="dppo", seed=0, **changes):
    """One row; `changes` replace what is in it."""
    config = json.loads(
        json.dumps(to_dict(resolve(preset("tuned", algo, env))))
    )  # with lists for tuples, as in a file
    generator = np.random.default_rng([seed, ALGORITHMS.index(algo), len(env)])
    height = HEIGHT[algo] * generator.normal(1, 0.15)
    steps = np.linspace(5_000, 999_424, 120).astype(int)
    curve = height * (1 - np.exp(-steps / 250_000)) + generator.normal(0, 60, len(steps))
    returns = generator.normal(height, 20, 20)
    best = {
        "steps": 800_000,
        "return_mean": height + 50,
        "return_std": 10.0,
        "returns": [height + 50] * 20,
    }
    found = {
        "cell": f"{env}-{algo}-{seed}", "env": env, "env_version": config["env_version"], "algo": algo, "physics": config["physics"],
        "variant": None, "seed": seed, "total_steps": 1_000_000, "steps": 999_424, "hash": f"{env}{algo}".ljust(12, "0")[:12],
        "final": {
            "engine": "gymnasium", "env": env, "episodes": 20, "return_mean": float(returns.mean()), "return_std": float(returns.std()),
            "returns": returns.tolist(),
        },
        "best": best,
        "curve": {"steps": steps.tolist(), "return": [None, *curve[1:].tolist()]},
        "evaluations": {"steps": [400_000, 800_000], "return_mean": [height / 2, height + 50]},
        "seconds": 80.0 + seed, "samples_per_second": 12_000.0 + 100 * seed, "policy": f"policies/{env}-{algo}-{seed}.msgpack",
        "config": config | {"seed": seed}, "versions": {"jax": "0.10.2", "mujoco": "4.0.0"}, "machine": {"device": "cpu: x", "cores": 1},
        "git_revision": "0" * 40, "command": f"dgae train --env {env} --algo {algo} --seed {seed}",
    }  # fmt: skip
    return found | changes


def plain(scores, env="hopper", algo="dppo", **changes):
    """Rows with these final returns, one per seed, and nothing else of interest."""
    return [
        row(
            env,
            algo,
            seed,
            **{"final": {"engine": "gymnasium", "return_mean": score, "returns": [score]}}
            | changes,
        )
        for seed, score in enumerate(scores)
    ]


def study(directory, rows, planned=()):
    """A study directory with these rows; its path."""
    directory.mkdir(parents=True, exist_ok=True)
    cells = {each["cell"]: each["config"] for each in rows} | {cell: {} for cell in planned}
    (directory / "study.json").write_text(json.dumps({"schema": 1, "cells": cells}))
    (directory / "results.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))
    return directory


def whole(envs=("ant", "hopper", "swimmer", "walker2d"), algorithms=ALGORITHMS, seeds=5):
    """Rows of a complete study."""
    return [row(env, algo, seed) for env in envs for algo in algorithms for seed in range(seeds)]
