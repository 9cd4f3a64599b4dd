"""Exported policies: one directory per format, each with a model card."""

import re
from collections.abc import Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.export import onnx_model
from dgae_jax.export.arrays import Arrays, arrays_of, to_npz
from dgae_jax.run import checkpoint, directory, files
from dgae_jax.run.metrics import EvaluationsFile
from dgae_jax.run.options import engines_of, eval_env_id
from dgae_jax.run.terminal import counted

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
    facts = {
        **facts_of(source, found.path, config, index),
        "task": eval_env_id(config),
        "algorithm": config.algo,
        "best": which == "best",
    }
    bundles = {kind: _files(kind, arrays, config, index, facts) for kind in formats}
    for kind, contents in bundles.items():
        (out / kind).mkdir(parents=True, exist_ok=True)
        for name, data in contents.items():
            files.replace(out / kind / name, data)
    return {kind: list(contents) for kind, contents in bundles.items()}


def _files(
    kind: str, arrays: Arrays, config: ResolvedConfig, index: int, facts: dict[str, Any]
) -> dict[str, bytes]:
    card = {"README.md": model_card(kind, arrays, config, index, facts).encode()}
    if kind == "onnx":
        names = ("task", "algorithm", "samples", "git_revision")
        metadata = {name: str(facts[name]) for name in names if facts[name] is not None}
        return {"policy.onnx": onnx_model.serialize(arrays, metadata), **card}
    programs = ("policy.py", "agent.py") if kind == "gymnasium" else ("policy.py",)
    copies = {name: (TEMPLATES / name).read_bytes() for name in programs}
    return {"policy.npz": to_npz(arrays), **copies, **card}


def model_card(
    kind: str, arrays: Arrays, config: ResolvedConfig, index: int, facts: dict[str, Any]
) -> str:
    """Return the text that says what the policy is, how well it does, how the files are used."""
    source = (TEMPLATES / "card.md").read_text(encoding="utf-8")
    jinja = jinja2.Environment(trim_blocks=True, undefined=jinja2.StrictUndefined)
    noise = {where: std for where, std in asdict(config.noise).items() if std}
    return jinja.from_string(source).render(
        facts,
        format=kind,
        trained_on=f"{config.task}, engine {config.physics}, seed {config.seed + index}",
        noise=", ".join(f"{where} {std:g}" for where, std in noise.items()),
        engine=engines_of(config)[0],
        critic=config.critic.kind,
        gamma=f"{config.gamma:g}",
        scaled=config.normalize_rewards,
        episode_length=int(arrays["episode_length"]),
        observations=arrays["observation_mean"].size,
        actions=arrays["action_low"].size,
        quantiles=config.critic.outputs,
    )


def facts_of(source: Path, found: Path, config: ResolvedConfig, index: int) -> dict[str, Any]:
    """Return what the files of a run say about a policy; None for what they do not say.

    Args:
        source: a run directory, or the file of a policy.
        found: the file with the networks.
        config: of the run.
        index: which of the seeds that were trained together, from 0.
    """
    seed = config.seed + index
    if source.is_file():
        row = _sweep_row(source, seed)
        samples, evaluation = row.get("steps"), row.get("final")
    else:
        row, samples = directory.last_part(source), int(found.stem.removeprefix("steps_"))
        rows = EvaluationsFile(source / "evaluations.jsonl").rows
        here = [each for each in rows if (each["steps"], each["seed"]) == (samples, seed)]
        evaluation = here[-1] if here else None
    versions, revision = row.get("versions"), str(row.get("git_revision"))
    known = versions.items() if isinstance(versions, dict) else ()
    return {
        "checkpoint": found.name,
        "samples": samples if type(samples) is int else None,
        "returns": _returns(evaluation),
        "versions": ", ".join(f"{name} {version}" for name, version in known if version),
        "git_revision": revision if re.fullmatch(r"[0-9a-f]{7,64}\+?", revision) else None,
    }


def _sweep_row(policy: Path, seed: int) -> dict[str, Any]:
    """Return the row of the sweep's `results.jsonl` that names this policy file, or nothing."""
    policy = policy.resolve()
    results, name = policy.parent.parent / "results.jsonl", f"{policy.parent.name}/{policy.name}"
    rows = [row for row, _ in files.whole_rows(results)] if results.is_file() else []
    matching = [row for row in rows if (row.get("policy"), row.get("seed")) == (name, seed)]
    return matching[-1] if matching else {}


def _returns(evaluation: Any) -> str | None:
    """Describe an evaluation; None for anything else, as a file may hold anything."""
    try:
        mean, std = evaluation["return_mean"], evaluation["return_std"]
        episodes = counted(len(evaluation["returns"]), "episode")
        return f"{mean:,.1f} ± {std:,.1f} over {episodes}"
    except (TypeError, KeyError, ValueError):
        return None
