"""What the files of a run say about an exported policy; what they do not say is None."""

import re
from pathlib import Path
from typing import Any, NamedTuple

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.run import directory, files
from dgae_jax.run.metrics import EvaluationsFile
from dgae_jax.run.terminal import counted


class Facts(NamedTuple):
    """About one policy, for its card."""

    checkpoint: str
    """The file it was read from."""
    samples: int | None
    returns: str | None
    """Mean and standard deviation of its evaluation."""
    versions: dict[str, str]
    """Of the libraries that trained it."""
    git_revision: str | None


def facts_of(source: Path, found: Path, config: ResolvedConfig, index: int) -> Facts:
    """`source` is a run directory or a policy's file, `found` the file that holds the networks."""
    seed = config.seed + index
    if source.is_file():
        row = _row_of_study(source, seed)
        return _facts(found, row.get("steps"), row.get("final"), row)
    samples = int(found.stem.removeprefix("steps_"))
    evaluated = EvaluationsFile(source / "evaluations.jsonl").rows
    here = [row for row in evaluated if (row["steps"], row["seed"]) == (samples, seed)]
    return _facts(found, samples, here[-1] if here else None, directory.last_part(source))


def _facts(found: Path, samples: Any, evaluation: Any, made: dict[str, Any]) -> Facts:
    """A file may hold anything."""
    versions, revision = made.get("versions"), str(made.get("git_revision"))
    known = versions.items() if isinstance(versions, dict) else ()
    return Facts(
        checkpoint=found.name,
        samples=samples if type(samples) is int else None,
        returns=_returns(evaluation),
        versions={str(name): str(version) for name, version in known if version is not None},
        git_revision=revision if re.fullmatch(r"[0-9a-f]{7,64}\+?", revision) else None,
    )


def _row_of_study(source: Path, seed: int) -> dict[str, Any]:
    """What came of the training of a policy whose file lies in a study: the row of `results.jsonl` that names it, or nothing."""
    study, name = source.resolve().parent.parent, f"{source.resolve().parent.name}/{source.name}"
    if not (study / "results.jsonl").is_file():
        return {}
    rows = [
        row
        for row, _ in files.whole_rows(study / "results.jsonl")
        if (row.get("policy"), row.get("seed")) == (name, seed)
    ]
    return rows[-1] if rows else {}


def _returns(evaluation: Any) -> str | None:
    try:
        mean, std, episodes = (
            evaluation["return_mean"],
            evaluation["return_std"],
            len(evaluation["returns"]),
        )
        return f"{mean:,.1f} ± {std:,.1f} over {counted(episodes, 'episode')}"
    except (TypeError, KeyError, ValueError):
        return None
