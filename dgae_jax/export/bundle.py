"""Exported policies: one directory per format, each with a model card.

A policy and its critic are plain arrays by name in every format:

- `policy_weight_I` [inputs, outputs], `policy_bias_I`: layers, first to last, tanh between them.
  `critic_weight_I` and `critic_bias_I` likewise.
- `critic_steps` [K - 1, K] of an ordered critic: its first output is the mean of its quantiles, to
  which softplus(the others) @ `critic_steps` is added.
- `critic_count` [1] of a sorted critic: its quantiles are its K outputs, sorted.
- Observations are normalized first: (obs - `observation_mean`) / `observation_std`, clipped to
  ± `observation_limit`.
- Actions are clipped to `action_low` … `action_high`.
- `env` is Gymnasium's id of the task, `episode_length` its time limit.
"""

import io
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jinja2
import numpy as np

from dgae_jax.configs.config import ConfigError
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.export import onnx_model
from dgae_jax.export.templates.policy import Policy as NumpyPolicy
from dgae_jax.learn.build import make_task
from dgae_jax.learn.normalizers import OBSERVATION_LIMIT
from dgae_jax.learn.types import InferenceState
from dgae_jax.maths.transport import GAP_BIAS, centered_cumsum
from dgae_jax.run import checkpoint, directory, files
from dgae_jax.run.api import Policy
from dgae_jax.run.checkpoint import Networks
from dgae_jax.run.episodes import time_limit
from dgae_jax.run.options import engines_of, eval_env_id
from dgae_jax.run.terminal import counted

Arrays = dict[str, np.ndarray]

TEMPLATES = resources.files("dgae_jax.export") / "templates"


def export(
    source: Path, config: ResolvedConfig, which: str, index: int, formats: Sequence[str], out: Path
) -> dict[str, list[str]]:
    """Write the directories `out`/FORMAT; nothing is written before everything is made.

    Args:
        source: a run directory, or the file of a policy.
        config: of the run.
        which: the checkpoint, latest or best.
        index: which of the seeds that were trained together, from 0.
        formats: any of npz, onnx, gymnasium.
        out: the directory to write in.

    Returns:
        The names of the files by format.

    Raises:
        ConfigError: as `checkpoint.load_networks` and `arrays_of`.
        OSError: a file cannot be written.
    """
    found = checkpoint.load_networks(source, config, which)
    arrays = arrays_of(found, config, index)
    facts = facts_of(source, found.path, config, index) | {"best": which == "best"}
    bundles = {}
    for kind in formats:
        if kind == "onnx":
            bundles[kind] = {"policy.onnx": onnx_model.serialize(arrays)}
        else:
            programs = ("policy.py", "agent.py") if kind == "gymnasium" else ("policy.py",)
            copies = {name: (TEMPLATES / name).read_bytes() for name in programs}
            bundles[kind] = {"policy.npz": to_npz(arrays), **copies}
        bundles[kind]["README.md"] = model_card(kind, arrays, config, index, facts).encode()
    for kind, contents in bundles.items():
        (out / kind).mkdir(parents=True, exist_ok=True)
        for name, data in contents.items():
            files.replace(out / kind / name, data)
    return {kind: list(contents) for kind, contents in bundles.items()}


def model_card(
    kind: str, arrays: Arrays, config: ResolvedConfig, index: int, facts: dict[str, Any]
) -> str:
    """Return the text that says what the policy is, how well it does, how the files are used."""
    jinja = jinja2.Environment(trim_blocks=True, undefined=jinja2.StrictUndefined)
    jinja.filters["counted"] = counted
    noise = {where: std for where, std in asdict(config.noise).items() if std}
    return jinja.from_string((TEMPLATES / "card.md").read_text(encoding="utf-8")).render(
        facts,
        format=kind,
        config=config,
        seed=config.seed + index,
        noise=", ".join(f"{where} {std:g}" for where, std in noise.items()),
        engine=engines_of(config)[0],
        task=arrays["env"],
        episode_length=int(arrays["episode_length"]),
        observations=arrays["observation_mean"].size,
        actions=arrays["action_low"].size,
    )


def facts_of(source: Path, found: Path, config: ResolvedConfig, index: int) -> dict[str, Any]:
    """Return what the files of a run say about the policy in the file `found`, None if nothing."""
    seed = config.seed + index
    if source.is_file():
        name = "/".join(source.resolve().parts[-2:])
        about = _last(source.resolve().parents[1] / "results.jsonl", policy=name, seed=seed)
        samples, evaluation = about.get("steps"), about.get("final")
    else:
        about, samples = directory.last_part(source), int(found.stem.removeprefix("steps_"))
        evaluation = _last(source / "evaluations.jsonl", steps=samples, seed=seed)
    return {
        "checkpoint": found.name,
        "samples": samples,
        "evaluation": evaluation or None,
        "versions": about.get("versions"),
        "git_revision": about.get("git_revision"),
    }


def _last(path: Path, **values: Any) -> dict[str, Any]:
    """Return the last row of a file that has these values, or nothing."""
    rows = [row for row, _ in files.whole_rows(path)] if path.is_file() else []
    matching = [row for row in rows if all(row.get(name) == x for name, x in values.items())]
    return matching[-1] if matching else {}


def arrays_of(found: Networks, config: ResolvedConfig, index: int) -> Arrays:
    """Return the arrays of one of the policies that were trained together.

    Raises:
        ConfigError: the arrays do not compute what the policy does, as its networks are custom.
    """
    policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
    try:
        arrays = _arrays(policy, critic, config)
        _compare(arrays, Policy(policy, critic, config))
    except (KeyError, ValueError, AssertionError) as reason:
        message = f"{found.path}: only networks of dgae_jax can be exported ({reason})"
        raise ConfigError(message) from reason
    return arrays


def _arrays(policy: InferenceState, critic: InferenceState, config: ResolvedConfig) -> Arrays:
    env, statistics = make_task(config), policy.obs_stats
    arrays = {**_layers("policy", policy.params), **_layers("critic", critic.params)}
    if config.critic.kind == "ordered":
        arrays |= _ordered(arrays)
    elif config.critic.kind == "sorted":
        arrays["critic_count"] = np.array([config.critic.outputs])
    size = int(env.observation_size)  # pyright: ignore[reportArgumentType]
    mean, std, limit = np.zeros(size), np.ones(size), np.inf
    if statistics is not None:
        mean, std, limit = statistics.mean, statistics.std, OBSERVATION_LIMIT
    low, high = env.action_range
    values = {"observation_mean": mean, "observation_std": std, "observation_limit": limit}
    values |= {"action_low": low, "action_high": high}
    arrays |= {name: np.asarray(value, np.float32) for name, value in values.items()}
    task = {"env": np.array(eval_env_id(config)), "episode_length": np.array(time_limit(config))}
    return arrays | task


def to_npz(arrays: Arrays) -> bytes:
    """Return the bytes of a `.npz` file."""
    file = io.BytesIO()
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def _layers(network: str, params: Any) -> Arrays:
    """Return the torso's layers and the head of a module of `learn.networks`."""
    torso, head = (params["params"].get(name, {}) for name in ("Torso_0", "Dense_0"))
    arrays = {}
    for i, layer in enumerate([*(torso[f"Dense_{i}"] for i in range(len(torso))), head]):
        arrays[f"{network}_weight_{i}"] = np.asarray(layer["kernel"])
        arrays[f"{network}_bias_{i}"] = np.asarray(layer["bias"])
    return arrays


def _ordered(layers: Arrays) -> Arrays:
    """Return the last bias and the matrix that make outputs quantiles (`monotone_quantiles`)."""
    last = [name for name in layers if name.startswith("critic_bias_")][-1]
    bias = layers[last] - np.float32(GAP_BIAS) * (np.arange(layers[last].size) > 0)
    return {
        last: bias.astype(np.float32),
        "critic_steps": np.asarray(centered_cumsum(bias.size), np.float32),
    }


def _compare(arrays: Arrays, policy: Policy) -> None:
    exported = NumpyPolicy(io.BytesIO(to_npz(arrays)))
    noise = np.random.default_rng(0).normal(size=(100, policy.observation_size))
    obs = arrays["observation_mean"] + 3 * noise * arrays["observation_std"]
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    close(exported(obs), policy(obs), err_msg="actions differ")
    close(exported.quantiles(obs), policy.quantiles(obs), err_msg="quantiles differ")
