"""Flags as people write them: understood where one thing can be meant, refused with the flag that is meant otherwise."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from itertools import pairwise
from typing import Any, get_type_hints

from dgae_jax.configs.algorithms import ALGORITHMS
from dgae_jax.configs.config import Config, ConfigError, flag
from dgae_jax.envs.registry import TASKS
from dgae_jax.run.options import RunOptions

ELSEWHERE = {
    "lr": "learning-rate", "step-size": "learning-rate", "n-epochs": "epochs", "update-epochs": "epochs", "num-epochs": "epochs",
    "num-minibatches": "minibatches", "n-minibatches": "minibatches", "clip-range": "clip", "clip-eps": "clip",
    "clip-coef": "clip", "target-kl": "radius", "max-kl": "radius", "delta": "radius", "cg-damping": "damping", "n-quantiles": "quantiles",
    "num-quantiles": "quantiles", "hidden-sizes": "hidden", "layers": "hidden",
    "gae-lambda": "lam", "lambda": "lam", "discount": "gamma", "n-steps": "num_steps", "num-steps": "num_steps", "unroll-length": "num_steps",
    "rollout-length": "num_steps", "n-envs": "num-envs", "timesteps": "total-steps", "total-timesteps": "total-steps",
    "num-timesteps": "total-steps", "env-id": "env", "env-name": "env", "task": "env", "algorithm": "algo", "agent": "algo",
    "engine": "physics", "backend": "physics", "logdir": "run-dir", "log-dir": "run-dir", "output-dir": "run-dir", "out-dir": "run-dir",
}  # fmt: skip
"""What other trainers call a setting, and its last name here."""


def _settings(cls: type, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Flags without their dashes, and their types."""
    hints = get_type_hints(cls)
    for f in fields(cls):
        kind, name = hints[f.name], prefix + f.name.replace("_", "-")
        yield from (
            _settings(kind, name + ".")
            if is_dataclass(kind) and isinstance(kind, type)
            else [(name, kind)]
        )


FLAGS = dict([*_settings(Config), *_settings(RunOptions)])


def understood(argv: Sequence[str]) -> list[str]:
    """The command line as the parser takes it: 1e6 where a number is whole, names in lower case, Hopper-v4 as task and version.

    Raises ConfigError for a flag that has another name here, naming it.
    """
    words: list[str] = []
    for word in argv:
        name, equals, value = word.partition("=")
        if name.startswith("--"):
            refuse_foreign(name)
            words += [name, value] if equals else [name]
        else:
            words.append(word)
    out: list[str] = []
    for before, word in zip(["", *words], words, strict=False):
        out += _value(before[2:].replace("_", "-"), word) if before.startswith("--") else [word]
    versions = {
        value for name, value in pairwise(out) if name.replace("_", "-") == flag("env_version")
    }
    if len(versions) > 1:
        raise ConfigError(f"--env-version: must be one, not {' and '.join(sorted(versions))}")
    return out


def refuse_foreign(name: str) -> None:
    """Raise ConfigError for a flag of another trainer, with its name here."""
    name = name.partition("=")[0]
    spelled = name[2:].replace("_", "-")
    part, dot, last = spelled.rpartition(".")
    ours = ELSEWHERE.get(last, last)
    meant = [
        each
        for each in FLAGS
        if each in (part + dot + ours, ours) or (not part and each.endswith("." + ours))
    ]
    if spelled not in FLAGS and meant:
        raise ConfigError(f"{name}: is written {' or '.join('--' + each for each in meant)}")


def _value(name: str, value: str) -> list[str]:
    """The value of a flag, and flags that it says more of."""
    if FLAGS.get(name) in (int, int | None) and re.fullmatch(
        r"[\d_.]+e\+?\d{1,2}", value, re.IGNORECASE
    ):
        try:
            number = float(value)
        except ValueError:
            return [value]
        return [str(int(number))] if number.is_integer() else [value]
    if name == "algo" and value.lower() in ALGORITHMS:
        return [value.lower()]
    task, dash, version = value.rpartition("-")
    if name == "env" and dash and task.lower() in TASKS and re.fullmatch(r"v\d+", version):
        return [task.lower(), flag("env_version"), version]
    return [value.lower()] if name == "env" and value.lower() in TASKS else [value]
