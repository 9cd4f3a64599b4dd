"""Who trains the cells of a study: this machine, a Ray cluster or Slurm.

A launcher is `launch(jobs, options)`, a context in which all jobs are on their way: tasks with `done()` and `result()`, the exit code
of the cell. Leaving it before they are done stops them, each with a checkpoint, but for Slurm's, which are in the hands of Slurm.
"""

import contextlib
import os
import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol

from dgae_jax.configs.config import invalid
from dgae_jax.configs.validation import lookup
from dgae_jax.physics.cores import cores
from dgae_jax.study import on_ray, on_slurm
from dgae_jax.study.work import Job, run


@dataclass(frozen=True)
class LaunchOptions:
    """Where the cells of a study are trained."""

    launcher: str = "local"
    """local (this machine), ray (a cluster) or slurm (an array of jobs)."""
    processes: int | None = None
    """local: runs at a time, each with as many of the cores; by default one per core, one in all with a GPU [processes]."""
    address: str | None = None
    """ray: HOST:PORT of the cluster's head, or auto; by default a cluster of this machine's own [address]."""
    cpus_per_run: int = 1
    """ray, slurm: cores of each run [cores]."""
    gpus_per_run: float = 0.0
    """ray, slurm: GPUs of each run; several runs may share one with ray [GPUs]."""
    slurm: tuple[str, ...] = ()
    """slurm: more of its settings, as partition=gpu time=240 (minutes) array_parallelism=32 [NAME=VALUE]."""


class Task(Protocol):
    """A cell on its way."""

    def done(self) -> bool:
        """Whether there is a result."""
        ...

    def result(self) -> int:
        """The exit code of the cell; raises whatever kept it from having one."""
        ...


Launcher = Callable[[Sequence[Job], LaunchOptions], AbstractContextManager[dict[Task, Job]]]
"""All jobs on their way."""


@contextlib.contextmanager
def local(jobs: Sequence[Job], options: LaunchOptions) -> Iterator[dict[Task, Job]]:
    """As many processes at a time as there are cores to give."""
    shares: queue.SimpleQueue[list[int]] = queue.SimpleQueue()
    for share in _shares(options.processes or _processes()):
        shares.put(share)
    ours, theirs = os.pipe()  # a cell lives as long as its input is open

    def work(job: Job) -> int:
        share = shares.get()
        try:
            return run(job, share, ours)
        finally:
            shares.put(share)

    with ThreadPoolExecutor(shares.qsize()) as pool:
        try:
            yield {pool.submit(work, job): job for job in jobs}
        finally:
            os.close(theirs)
            pool.shutdown(cancel_futures=True)
            os.close(ours)


def _processes() -> int:
    """Programs on a CPU gain less from a second core than a second program does; a GPU is filled by one."""
    accelerated = (
        any(find_spec(name) for name in ("jax_cuda12_plugin", "jax_cuda13_plugin"))
        and os.environ.get("JAX_PLATFORMS") != "cpu"
    )
    return 1 if accelerated else cores()


def _shares(processes: int) -> list[list[int]]:
    """The cores of this process divided between so many, as many for each, because a cell goes on with the number that it was begun with;
    at least one. None is pinned where there is one process, or no pinning.
    """
    if processes == 1 or not hasattr(os, "sched_getaffinity"):
        return [[] for _ in range(processes)]
    ours = sorted(os.sched_getaffinity(0))
    each = max(1, len(ours) // processes)
    return [[ours[(each * i + k) % len(ours)] for k in range(each)] for i in range(processes)]


LAUNCHERS: dict[str, Launcher] = {"local": local, "ray": on_ray.launch, "slurm": on_slurm.launch}
"""By name."""


_MEANT_FOR = {
    "processes": ("local",),
    "address": ("ray",),
    "cpus_per_run": ("ray", "slurm"),
    "gpus_per_run": ("ray", "slurm"),
    "slurm": ("slurm",),
}
"""The launchers that take a setting."""


Launch = Callable[[Sequence[Job]], AbstractContextManager[dict[Task, Job]]]
"""A launcher that knows its options."""


def launcher(options: LaunchOptions) -> Launch:
    """The one that is asked for, after a look at everything that can be seen at once; raises ConfigError."""
    found = lookup("launcher", options.launcher, LAUNCHERS)
    usual = LaunchOptions()
    for name, meant in _MEANT_FOR.items():
        value = getattr(options, name)
        if value != getattr(usual, name) and options.launcher not in meant:
            raise invalid(name, value, f"left out with --launcher {options.launcher}")
    if options.processes is not None and not 1 <= options.processes <= 1024:
        raise invalid("processes", options.processes, "a whole number from 1 to 1,024")
    if not 1 <= options.cpus_per_run <= 1024:
        raise invalid("cpus_per_run", options.cpus_per_run, "a whole number from 1 to 1,024")
    if not 0 <= options.gpus_per_run <= 64:
        raise invalid("gpus_per_run", options.gpus_per_run, "from 0 to 64")
    if options.launcher == "ray":
        on_ray.check(options.address)
    if options.launcher == "slurm":
        on_slurm.check(options.slurm, options.gpus_per_run)
    return lambda jobs: found(jobs, options)
