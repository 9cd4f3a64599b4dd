"""Exported policies: one directory per format, each with a model card."""

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
from dgae_jax.run.options import engines_of
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
