"""What leaves the house, one directory per format: the policy, programs that act by it, and its card."""

import inspect
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.export import graph
from dgae_jax.export.arrays import Arrays, arrays_of, packed
from dgae_jax.export.card import card
from dgae_jax.export.facts import Facts, facts_of
from dgae_jax.export.outside.policy import Policy
from dgae_jax.run import checkpoint, files

IMPORT = "from dgae_jax.export.outside.policy import Policy\n"
"""The line of the agent's source in whose place the class itself is put."""


class Exported(NamedTuple):
    """One policy, ready to be written in any format."""

    arrays: Arrays
    config: ResolvedConfig
    facts: Facts


def _npz(policy: Exported) -> dict[str, bytes]:
    return {"policy.npz": packed(policy.arrays), "policy.py": _source("policy.py").encode()}


def _onnx(policy: Exported) -> dict[str, bytes]:
    facts, config = policy.facts, policy.config
    about = {
        "task": str(policy.arrays["env"]),
        "algorithm": str(config.algo),
        "samples": facts.samples,
        "git_revision": facts.git_revision,
    }
    return {
        "policy.onnx": graph.model(
            policy.arrays, {name: str(value) for name, value in about.items() if value is not None}
        )
    }


def _gymnasium(policy: Exported) -> dict[str, bytes]:
    before, after = _source("agent.py").split(IMPORT)
    return {
        "policy.npz": packed(policy.arrays),
        "agent.py": f"{before}\n{inspect.getsource(Policy)}{after}".encode(),
    }


def _source(name: str) -> str:
    return (resources.files("dgae_jax.export") / "outside" / name).read_text(encoding="utf-8")


FILES: dict[str, Callable[[Exported], dict[str, bytes]]] = {
    "npz": _npz,
    "onnx": _onnx,
    "gymnasium": _gymnasium,
}
"""The files of each format."""


def export(
    source: Path, config: ResolvedConfig, which: str, index: int, formats: Sequence[str], out: Path
) -> dict[str, list[str]]:
    """Write the directories `out`/FORMAT and name the files in each; nothing is written before all is made.

    `source` is a run directory or a policy's file, `index` that among the seeds trained side by side. Raises as
    `restore.trained` and `arrays_of`, OSError where a file cannot be written.
    """
    found = checkpoint.load_networks(source, config, which)
    policy = Exported(
        arrays_of(found, config, index), config, facts_of(source, found.path, config, index)
    )
    made: dict[str, dict[str, Any]] = {}
    for kind in formats:
        text = card(kind, policy.arrays, config, index, policy.facts, which)
        made[kind] = {**FILES[kind](policy), "README.md": text.encode()}
    for kind, contents in made.items():
        (out / kind).mkdir(parents=True, exist_ok=True)
        for name, data in contents.items():
            files.replace(out / kind / name, data)
    return {kind: list(contents) for kind, contents in made.items()}
