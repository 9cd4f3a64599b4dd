"""What a user may choose about a run beside its configuration."""

import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import spec_of

METRIC_LOGGERS = {"tensorboard": "tensorboardX", "wandb": "wandb", "mlflow": "mlflow"}
"""Viewers of metrics that a run can feed, and the library that each takes."""


@dataclass(frozen=True)
class RunOptions:
    """What a run leaves on this machine; nothing here changes its result."""

    run_dir: Path | None = None
    """Directory to write, new or empty; by default runs/ENV-ALGO-SEED-TIME [path]."""
    cache_dir: str = "~/.cache/dgae_jax"
    """Where compiled programs are kept between runs; none disables [path]."""
    checkpoint_every: int = 200_000
    """Samples of each run between checkpoints, which are evaluated too; one is always saved at the end [environment steps]."""
    keep_checkpoints: int = 3
    """The latest checkpoints that are kept, beside the one with the best evaluation [files]."""
    devices: int | None = None
    """Devices of each process that share the run, which divide its worlds or its seeds; by default all, and of a CPU's cores as
    many as have 16 worlds each [devices]."""
    coordinator: str | None = None
    """Where the processes of a run on several hosts meet, HOST:PORT of the first; Slurm, Open MPI, Kubernetes and TPU pods say it
    themselves [address]."""
    num_processes: int | None = None
    """Processes that share the run; 1 to train alone where a scheduler started several [processes]."""
    process_id: int | None = None
    """Which of them this is, from 0; the first one writes."""
    resume: Path | None = None
    """Continue the run in this directory, bit for bit, with its flags where none are given [path]."""
    resume_or_start: bool = False
    """Continue the run in --run-dir if there is one, otherwise start it there: one command for schedulers that requeue."""
    inexact: bool = False
    """Let --resume continue with another --physics, device, number of cores or versions: the same in the statistical sense only."""
    max_nonfinite: int = 10
    """Failures in a row before the run is stopped: an update not finite and left out, or most world steps invalid [iterations]."""
    eval_engine: str | None = None
    """Where policies are evaluated: gymnasium, whose task has no noise, or an engine as in --physics, with the noise of the
    training; by default the first that the task has."""
    episodes: int = 20
    """Episodes of every evaluation, per run [episodes]."""
    debug_nonfinite: bool = False
    """Write the states and actions from which worlds turn non-finite to nonfinite/ in the run directory, for replay."""
    log: tuple[str, ...] = ()
    """Viewers that get the metrics too: tensorboard, wandb, mlflow; several may be named, --log alone means none."""

    def __post_init__(self):
        object.__setattr__(self, "log", tuple(self.log))  # a list, from Python or JSON


INTEGER_RANGES = {
    "devices": (1, 100_000, "in one machine"),
    "num_processes": (1, 100_000, "in one run"),
    "process_id": (0, 99_999, "processes are counted from 0"),
    "checkpoint_every": (1, 2**31 - 1, "samples are counted in an int32"),
    "keep_checkpoints": (1, 1_000_000, "files in one directory"),
    "max_nonfinite": (1, 2**31 - 1, "iterations are counted in an int32"),
    "episodes": (1, 10_000, "they are played side by side"),
}
"""Whole numbers: from, to, and why not more."""


def validate_options(options: RunOptions, config: ResolvedConfig) -> None:
    """Raise `ConfigError` for the first option that is invalid, in a run of `config`."""
    engine_of(config, options.eval_engine, "eval_engine")
    for name, (low, high, reason) in INTEGER_RANGES.items():
        value = getattr(options, name)
        if value is not None and not (type(value) is int and low <= value <= high):
            raise invalid(name, value, f"a whole number from {low:,} to {high:,} ({reason})")
    _validate_log(options.log)
    if options.coordinator is not None:
        if not re.fullmatch(r"[^\s:]+:\d{1,5}", options.coordinator):
            raise invalid("coordinator", options.coordinator, "HOST:PORT")
        for name in ("num_processes", "process_id"):
            if getattr(options, name) is None:
                raise invalid(name, None, "given with --coordinator")
    elif options.process_id is not None or options.num_processes not in (None, 1):
        name = "num_processes" if options.process_id is None else "process_id"
        raise invalid(name, getattr(options, name), "left out without --coordinator")
    if options.process_id is not None and options.process_id >= (options.num_processes or 0):
        raise invalid(
            "process_id", options.process_id, f"below --num-processes {options.num_processes}"
        )
    if options.resume is not None and options.run_dir is not None:
        raise invalid("run_dir", options.run_dir, f"left out: --resume writes to {options.resume}")
    if options.resume is not None and options.resume_or_start:
        raise invalid("resume_or_start", True, "left out: --resume only resumes")
    if options.resume_or_start and options.run_dir is None:
        raise invalid("resume_or_start", True, "used with the directory to look in, --run-dir DIR")
    if options.inexact and options.resume is None and not options.resume_or_start:
        raise invalid("inexact", True, "left out without --resume")


def _validate_log(names: tuple[str, ...]) -> None:
    for name in names:
        if name not in METRIC_LOGGERS:
            raise invalid("log", name, f"one or more of {', '.join(METRIC_LOGGERS)}")
        if names.count(name) > 1:
            raise invalid("log", names, "each viewer once")
        spec = importlib.util.find_spec(METRIC_LOGGERS[name])
        if (
            spec is None or spec.origin is None
        ):  # a folder of that name in the working directory, such as Weights & Biases leaves
            raise ConfigError(
                f'log {name}: {METRIC_LOGGERS[name]} is missing; pip install "dgae_jax[{name}]"',
                "log",
            )


_KEPT = (
    "devices",
    "checkpoint_every",
    "keep_checkpoints",
    "max_nonfinite",
    "eval_engine",
    "episodes",
    "debug_nonfinite",
    "log",
)
"""What a run goes on with when it is resumed."""


def saved_options(options: RunOptions) -> dict[str, Any]:
    """What a run goes on with, for JSON."""
    return {name: getattr(options, name) for name in _KEPT} | {"log": list(options.log)}


def read_options(data: Any) -> RunOptions:
    """What `saved_options` wrote; defaults for all else."""
    found = data if isinstance(data, dict) else {}
    usual = saved_options(RunOptions(devices=1, eval_engine=""))
    kept: dict[str, Any] = {
        name: found[name] for name in _KEPT if type(found.get(name)) is type(usual[name])
    }
    viewers: dict[str, Any] = {
        "log": [name for name in METRIC_LOGGERS if name in kept.get("log", [])]
    }
    return RunOptions(**kept | viewers)


def engines_of(config: ResolvedConfig) -> tuple[str, ...]:
    """Where a run can be evaluated, the referee first: Gymnasium for our tasks and its own, the run's own physics for any other."""
    spec = spec_of(config.env)
    return ("gymnasium", *spec.engines) if spec.referees else spec.engines


def engine_of(config: ResolvedConfig, engine: str | None, setting: str = "engine") -> str:
    """The engine of that name, the first of `engines_of` where there is none; raises ConfigError if the run cannot have it.

    `setting` is what the name was given as.
    """
    if engine is not None and engine not in engines_of(config):
        raise invalid(setting, engine, f"one of {', '.join(engines_of(config))} with {config.env}")
    return engine or engines_of(config)[0]


def eval_env_id(config: ResolvedConfig) -> str:
    """Gymnasium's name of the task, or ours where Gymnasium does not play it."""
    return spec_of(config.env).referee(config.env_version) or config.env
