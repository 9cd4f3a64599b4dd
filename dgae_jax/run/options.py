"""Options of a run beside its configuration: where it is written, evaluated and shared."""

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import spec_of

METRIC_LOGGERS = {"tensorboard": "tensorboardX", "wandb": "wandb", "mlflow": "mlflow"}
"""Metric loggers, and the library that each needs."""


@dataclass(frozen=True)
class RunOptions:
    """Options that do not change the result of a run."""

    run_dir: Path | None = None
    """Directory to write, new or empty; by default runs/ENV-ALGO-SEED-TIME [path]."""
    cache_dir: str = "~/.cache/dgae_jax"
    """Directory of compiled programs, kept between runs; none disables [path]."""
    checkpoint_every: int = 200_000
    """Samples of each run between checkpoints, which are evaluated too [environment steps]."""
    keep_checkpoints: int = 3
    """Latest checkpoints to keep, beside the one with the best evaluation [files]."""
    devices: int | None = None
    """Devices of each process, which divide the envs or the seeds; by default all; on a CPU at
    most one per 16 envs [devices]."""
    coordinator: str | None = None
    """Address of the first of several processes, HOST:PORT; detected under Slurm, Open MPI,
    Kubernetes and on TPU pods [address]."""
    num_processes: int | None = None
    """Processes that share the run; 1 to train alone under a scheduler [processes]."""
    process_id: int | None = None
    """Number of this process, from 0; the first one writes."""
    resume: Path | None = None
    """Continue the run in this directory, bit for bit, with its flags unless given [path]."""
    resume_or_start: bool = False
    """Continue the run in --run-dir if there is one, otherwise start it there."""
    inexact: bool = False
    """Let --resume continue with other physics, devices, cores or versions: not bit-identical."""
    max_nonfinite: int = 10
    """Failed iterations in a row (a skipped update, or most env steps masked) before the run
    stops [iterations]."""
    eval_engine: str | None = None
    """Engine of evaluations: gymnasium (no noise) or an engine of --physics (training noise); by
    default gymnasium where the task has it."""
    episodes: int = 20
    """Episodes of every evaluation, per run [episodes]."""
    debug_nonfinite: bool = False
    """Write the states and actions from which envs turn non-finite to RUN_DIR/nonfinite/."""
    log: tuple[str, ...] = ()
    """Metric loggers: tensorboard, wandb, mlflow; --log alone means none."""

    def __post_init__(self):
        object.__setattr__(self, "log", tuple(dict.fromkeys(self.log)))  # perhaps a list


class SavedOptions(TypedDict, total=False):
    """Options that a resumed run keeps."""

    devices: int | None
    checkpoint_every: int
    keep_checkpoints: int
    max_nonfinite: int
    eval_engine: str | None
    episodes: int
    debug_nonfinite: bool
    log: tuple[str, ...]


class TrainOptions(SavedOptions, total=False):
    """Keyword options of `dgae_jax.train`: fields of `RunOptions`."""

    cache_dir: str
    coordinator: str | None
    num_processes: int | None
    process_id: int | None
    resume_or_start: bool
    inexact: bool


COUNTS = ("devices", "checkpoint_every", "keep_checkpoints", "max_nonfinite", "episodes")


def engines_of(config: ResolvedConfig) -> tuple[str, ...]:
    """Return the engines that can evaluate a run, the default first."""
    spec = spec_of(config.env)
    return ("gymnasium", *spec.engines) if spec.eval_envs else spec.engines


def engine_of(config: ResolvedConfig, engine: str | None, setting: str = "engine") -> str:
    """Return the engine of that name, or the default.

    Raises:
        ConfigError: the run cannot be evaluated there; `setting` names the flag.
    """
    engines = engines_of(config)
    if engine is not None and engine not in engines:
        raise invalid(setting, engine, f"one of {', '.join(engines)} with {config.env}")
    return engine or engines[0]


def eval_env_id(config: ResolvedConfig) -> str:
    """Return Gymnasium's id of the evaluation env, or our name where Gymnasium lacks the task."""
    return spec_of(config.env).eval_env(config.env_version) or config.env


def validate_options(options: RunOptions, config: ResolvedConfig) -> None:
    """Raise ConfigError for the first option that is invalid in a run of `config`."""
    engine_of(config, options.eval_engine, "eval_engine")
    for name in COUNTS:
        value = getattr(options, name)
        if value is not None and not (type(value) is int and 1 <= value < 2**31):
            raise invalid(name, value, f"a whole number from 1 to {2**31 - 1:,}")
    for name in options.log:
        if name not in METRIC_LOGGERS:
            raise invalid("log", name, f"one or more of {', '.join(METRIC_LOGGERS)}")
        library = METRIC_LOGGERS[name]
        spec = importlib.util.find_spec(library)
        if spec is None or spec.origin is None:  # a folder of that name, such as wandb leaves
            install = f'pip install "dgae_jax[{name}]"'
            raise ConfigError(f"log {name}: {library} is missing; {install}", "log")
    if options.resume is not None and options.run_dir is not None:
        both = f"run_dir {options.run_dir}: cannot be combined with --resume {options.resume}"
        raise ConfigError(both, "run_dir")
    if options.resume_or_start and options.run_dir is None:
        raise invalid("resume_or_start", True, "used with --run-dir DIR")
    if options.inexact and options.resume is None and not options.resume_or_start:
        raise ConfigError("inexact: needs --resume or --resume-or-start", "inexact")
