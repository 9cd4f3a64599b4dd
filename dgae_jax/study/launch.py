"""Launchers of a sweep: this machine, a Ray cluster or Slurm.

A launcher is `launch(jobs, options)`, a context in which all jobs are on their way. The result of
a task is the exit code of its job. On leaving the context, jobs that are not done stop with a
checkpoint; those of Slurm continue.
"""

import contextlib
import logging
import os
import queue
import shutil
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.validation import lookup
from dgae_jax.physics import cores
from dgae_jax.study.worker import Job, execute


@dataclass(frozen=True)
class LaunchOptions:
    """The launcher of a sweep and its settings."""

    launcher: str = "local"
    """local (this machine), ray (a cluster) or slurm (an array of jobs)."""
    processes: int | None = None
    """local: runs at a time, each with an equal share of the cores; by default one per core, or
    one in all with a GPU [processes]."""
    address: str | None = None
    """ray: HOST:PORT of the cluster's head, or auto; by default a cluster on this machine
    [address]."""
    cpus_per_run: int = 1
    """ray, slurm: cores of each run [cores]."""
    gpus_per_run: float = 0.0
    """ray, slurm: GPUs of each run; several runs may share one with ray [GPUs]."""
    slurm: tuple[str, ...] = ()
    """slurm: more of its settings, as partition=gpu time=240 (minutes) array_parallelism=32
    [NAME=VALUE]."""


Tasks = dict[Any, Job]
"""By task; a task has the methods `done` and `result` of `concurrent.futures.Future`."""

Launcher = Callable[[Sequence[Job], LaunchOptions], AbstractContextManager[Tasks]]
Launch = Callable[[Sequence[Job]], AbstractContextManager[Tasks]]
"""A launcher with its options."""


@contextlib.contextmanager
def local(jobs: Sequence[Job], options: LaunchOptions) -> Iterator[Tasks]:
    """Run as many processes at a time as there are shares of the cores."""
    shares: queue.SimpleQueue[list[int]] = queue.SimpleQueue()
    for share in _shares(options.processes or _default_processes()):
        shares.put(share)
    read_end, write_end = os.pipe()

    def work(job: Job) -> int:
        share = shares.get()
        try:
            return execute(job, share, read_end)
        finally:
            shares.put(share)

    with ThreadPoolExecutor(shares.qsize()) as pool:
        try:
            yield {pool.submit(work, job): job for job in jobs}
        finally:
            os.close(write_end)
            pool.shutdown(cancel_futures=True)
            os.close(read_end)


def _default_processes() -> int:
    """Return one per core, as a run gains less from a second core than a second run does."""
    plugins = ("jax_cuda12_plugin", "jax_cuda13_plugin")
    has_gpu = any(map(find_spec, plugins)) and os.environ.get("JAX_PLATFORMS") != "cpu"
    return 1 if has_gpu else cores()


def _shares(processes: int) -> list[list[int]]:
    """Divide the cores evenly, because a run resumes with the number of cores it began with."""
    if processes == 1 or not hasattr(os, "sched_getaffinity"):
        return [[] for _ in range(processes)]
    ours = sorted(os.sched_getaffinity(0))
    each = max(1, len(ours) // processes)
    return [[ours[(each * i + k) % len(ours)] for k in range(each)] for i in range(processes)]


@contextlib.contextmanager
def ray_cluster(jobs: Sequence[Job], options: LaunchOptions) -> Iterator[Tasks]:
    """Run jobs as tasks of a Ray cluster; the nodes share the directory of the sweep.

    If a node dies its tasks are retried on another, and resume from the checkpoints of their runs.
    """
    import ray  # pyright: ignore[reportMissingImports]

    quiet: Any = {"log_to_driver": False, "logging_level": logging.ERROR}
    try:
        ray.init(options.address or "local", ignore_reinit_error=True, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as reason:
        allowed = f"where a Ray cluster answers ({str(reason).splitlines()[0][:200]})"
        raise invalid("address", options.address, allowed) from reason
    resources: Any = {"num_cpus": options.cpus_per_run, "num_gpus": options.gpus_per_run}
    task = ray.remote(max_retries=-1, **resources)(execute)
    try:
        yield {task.remote(job).future(): job for job in jobs}
    finally:
        ray.shutdown()


def _check_ray(options: LaunchOptions) -> None:
    if options.address not in (None, "auto", "local"):
        host, _, port = str(options.address).removeprefix("ray://").rpartition(":")
        try:  # ray.init waits for minutes
            socket.create_connection((host, int(port)), timeout=5.0).close()
        except (OSError, OverflowError, ValueError) as reason:
            allowed = f"auto, or HOST:PORT where a Ray cluster answers ({reason})"
            raise invalid("address", options.address, allowed) from reason
    if not find_spec("ray"):
        raise invalid("launcher", "ray", 'used with Ray installed: pip install "dgae_jax[ray]"')


SLURM_EXECUTOR = "slurm"
"""Name of submitit's executor; tests use its `local` one."""


@contextlib.contextmanager
def slurm_array(jobs: Sequence[Job], options: LaunchOptions) -> Iterator[Tasks]:
    """Run jobs as one Slurm array, which outlives this process."""
    import submitit

    class Resumable(submitit.helpers.Checkpointable):  # submitted again if it was preempted
        def __call__(self, job: Job) -> int:
            return execute(job)

    folder = jobs[0].log.parent.parent / "slurm" / "%j"
    executor = submitit.AutoExecutor(folder=folder, cluster=SLURM_EXECUTOR)
    gpus = {"gpus_per_node": int(options.gpus_per_run)} if options.gpus_per_run else {}
    try:
        executor.update_parameters(
            name="dgae", cpus_per_task=options.cpus_per_run, **gpus, **slurm_parameters(options)
        )
        submitted: Any = executor.map_array(Resumable(), jobs)
    except (NameError, TypeError, submitit.core.utils.FailedSubmissionError) as reason:
        allowed = f"must be settings that submitit and Slurm take ({str(reason)[:300]})"
        raise ConfigError(f"slurm: {allowed}", "slurm") from reason
    yield dict(zip(submitted, jobs, strict=True))


def slurm_parameters(options: LaunchOptions) -> dict[str, Any]:
    """Return submitit's parameters; raise ConfigError for a setting that is not NAME=VALUE."""
    found = {}
    for setting in options.slurm:
        name, _, value = setting.partition("=")
        if not (name.isidentifier() and value):
            raise invalid("slurm", setting, "NAME=VALUE, as partition=gpu")
        found[f"slurm_{name.removeprefix('slurm_')}"] = int(value) if value.isdigit() else value
    return found


def _check_slurm(options: LaunchOptions) -> None:
    if not find_spec("submitit"):
        how = 'used with submitit installed: pip install "dgae_jax[slurm]"'
        raise invalid("launcher", "slurm", how)
    if SLURM_EXECUTOR == "slurm" and not shutil.which("sbatch"):
        raise invalid("launcher", "slurm", "used where Slurm is: there is no sbatch here")
    if options.gpus_per_run != int(options.gpus_per_run):
        raise invalid("gpus_per_run", options.gpus_per_run, "a whole number with --launcher slurm")
    slurm_parameters(options)


LAUNCHERS: dict[str, Launcher] = {"local": local, "ray": ray_cluster, "slurm": slurm_array}

CHECKS = {"ray": _check_ray, "slurm": _check_slurm}

RANGES = {
    "processes": (("local",), 1, 1024),
    "address": (("ray",), None, None),
    "cpus_per_run": (("ray", "slurm"), 1, 1024),
    "gpus_per_run": (("ray", "slurm"), 0, 64),
    "slurm": (("slurm",), None, None),
}
"""The launchers that use a setting, and its least and largest value."""


def launcher(options: LaunchOptions) -> Launch:
    """Return the launcher that is asked for.

    Raises:
        ConfigError: an option is invalid, or Ray or Slurm is not there.
    """
    found = lookup("launcher", options.launcher, LAUNCHERS)
    for name, (used_by, low, high) in RANGES.items():
        value = getattr(options, name)
        if value == getattr(LaunchOptions, name):
            continue
        if options.launcher not in used_by:
            allowed = f"unset: it has no effect with --launcher {options.launcher}"
            raise invalid(name, value, allowed)
        if low is not None and not low <= value <= high:
            raise invalid(name, value, f"from {low} to {high:,}")
    if options.launcher in CHECKS:
        CHECKS[options.launcher](options)
    return lambda jobs: found(jobs, options)
