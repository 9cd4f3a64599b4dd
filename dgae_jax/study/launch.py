"""Launchers of a sweep: this machine, a Ray cluster or Slurm.

A launcher is `launch(jobs)`, a context in which all jobs are on their way. The result of
a task is the exit code of its job. On leaving the context, jobs that are not done stop with a
checkpoint; those of Slurm continue.
"""

import contextlib
import logging
import os
import queue
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from importlib.util import find_spec
from typing import Any

from dgae_jax.configs.config import invalid
from dgae_jax.physics import cores
from dgae_jax.study.worker import Job, execute

Tasks = dict[Any, Job]
"""By task; a task has the methods `done` and `result` of `concurrent.futures.Future`."""

Launch = Callable[[Sequence[Job]], AbstractContextManager[Tasks]]


@contextlib.contextmanager
def local(jobs: Sequence[Job], processes: int) -> Iterator[Tasks]:
    """Run so many processes at a time, each with an equal share of the cores."""
    shares: queue.SimpleQueue[list[int]] = queue.SimpleQueue()
    for share in _shares(processes):
        shares.put(share)
    read_end, write_end = os.pipe()

    def work(job: Job) -> int:
        share = shares.get()
        try:
            return execute(job, share, read_end)
        finally:
            shares.put(share)

    with ThreadPoolExecutor(processes) as pool:
        try:
            yield {pool.submit(work, job): job for job in jobs}
        finally:
            os.close(write_end)
            pool.shutdown(cancel_futures=True)
            os.close(read_end)


def default_processes() -> int:
    """Return one per core, as a run gains less from a second core than a second run does.

    With a GPU it is one in all.
    """
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
def ray_cluster(
    jobs: Sequence[Job], address: str | None, cpus: int, gpus: float
) -> Iterator[Tasks]:
    """Run jobs as tasks of a Ray cluster; the nodes share the directory of the sweep.

    If a node dies its tasks are retried on another, and resume from the checkpoints of their runs.
    """
    import ray  # pyright: ignore[reportMissingImports]

    quiet: Any = {"log_to_driver": False, "logging_level": logging.ERROR}
    try:
        ray.init(address or "local", ignore_reinit_error=True, **quiet)
        task = ray.remote(max_retries=-1, num_cpus=cpus, num_gpus=gpus)(execute)
    except (ConnectionError, RuntimeError, ValueError) as reason:
        allowed = f"used with a cluster and options that Ray takes ({str(reason)[:300]})"
        raise invalid("launcher", "ray", allowed) from reason
    try:
        yield {task.remote(job).future(): job for job in jobs}
    finally:
        ray.shutdown()


def check_ray(address: str | None) -> None:
    """Raise ConfigError unless something answers at the address; `ray.init` waits for minutes."""
    if address not in (None, "auto", "local"):
        host, _, port = address.removeprefix("ray://").rpartition(":")
        try:
            socket.create_connection((host, int(port)), timeout=5.0).close()
        except (OSError, OverflowError, ValueError) as reason:
            allowed = f"auto, or HOST:PORT where a Ray cluster answers ({reason})"
            raise invalid("address", address, allowed) from reason


@contextlib.contextmanager
def slurm_array(
    jobs: Sequence[Job], cpus: int, gpus: float, settings: Sequence[str]
) -> Iterator[Tasks]:
    """Run jobs as one Slurm array, which outlives this process."""
    import submitit

    class Resumable(submitit.helpers.Checkpointable):  # submitted again if it was preempted
        def __call__(self, job: Job) -> int:
            return execute(job)

    parameters: dict[str, Any] = {"name": "dgae", "cpus_per_task": cpus}
    if gpus:
        parameters["gpus_per_node"] = int(gpus)
    for setting in settings:
        name, _, value = setting.partition("=")
        parameters[f"slurm_{name}"] = int(value) if value.isdigit() else value
    try:
        executor = submitit.AutoExecutor(jobs[0].log.parent.parent / "slurm" / "%j", "slurm")
        executor.update_parameters(**parameters)
        submitted: Any = executor.map_array(Resumable(), jobs)
    except (NameError, RuntimeError, TypeError, ValueError) as reason:
        allowed = f"used with settings that submitit and Slurm take ({str(reason)[:300]})"
        raise invalid("launcher", "slurm", allowed) from reason
    yield dict(zip(submitted, jobs, strict=True))
