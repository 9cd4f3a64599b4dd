"""Cells as an array of Slurm jobs, by submitit. They go on when the command that submitted them ends; a job that is requeued continues."""

import contextlib
import shutil
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import Any

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.study.work import Job, run

CLUSTER = "slurm"
"""Submitit's name of the executor; its `local` one is for tests."""


class _Cell:
    """What a job calls; submitit submits it again where it was preempted or timed out."""

    def __call__(self, job: Job) -> int:
        return run(job)

    def checkpoint(self, job: Job) -> Any:
        """The same once more: the run continues from its own checkpoint."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, job)


def check(settings: Sequence[str], gpus: float) -> None:
    """Raise ConfigError if there is no Slurm here, or a setting is not NAME=VALUE."""
    if not find_spec("submitit"):
        raise invalid(
            "launcher", "slurm", 'used with submitit installed: pip install "dgae_jax[slurm]"'
        )
    if CLUSTER == "slurm" and not shutil.which("sbatch"):
        raise invalid("launcher", "slurm", "used where Slurm is: there is no sbatch here")
    if gpus != int(gpus):
        raise invalid("gpus_per_run", gpus, "a whole number with --launcher slurm")
    parameters(settings)


def parameters(settings: Sequence[str]) -> dict[str, Any]:
    """Submitit's parameters from NAME=VALUE; whole numbers are numbers."""
    found = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not (name.isidentifier() and equals and value):
            raise invalid("slurm", setting, "NAME=VALUE, as partition=gpu")
        found[f"slurm_{name.removeprefix('slurm_')}"] = int(value) if value.isdigit() else value
    return found


@contextlib.contextmanager
def launch(jobs: Sequence[Job], options: Any) -> Iterator[dict[Any, Job]]:
    """All jobs as one array."""
    import submitit

    executor = submitit.AutoExecutor(folder=jobs[0].study.path / "slurm" / "%j", cluster=CLUSTER)
    try:
        executor.update_parameters(
            name="dgae", cpus_per_task=options.cpus_per_run, **parameters(options.slurm)
        )
        if options.gpus_per_run:
            executor.update_parameters(gpus_per_node=int(options.gpus_per_run))
        submitted = executor.map_array(_Cell(), jobs)
    except (NameError, TypeError, submitit.core.utils.FailedSubmissionError) as reason:
        raise ConfigError(
            f"slurm: must be settings that submitit and Slurm take ({str(reason)[:300]})", "slurm"
        ) from reason
    yield dict(zip(submitted, jobs, strict=True))
