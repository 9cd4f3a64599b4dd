"""Several processes, on one host or on many, that share a run: all of them compute, and the first one writes.

The others do the same in a directory of their own, which they throw away, and say nothing. What decides the course of a run,
the clock and signals, is agreed on, so that every process makes the same calls.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from dgae_jax.configs.config import ConfigError
from dgae_jax.run import terminal
from dgae_jax.run.options import RunOptions


def join(options: RunOptions) -> None:
    """Meet the other processes of the run, if there are any; raises ConfigError if they do not come."""
    if (
        jax.distributed.is_initialized()
        or options.num_processes == 1
        or not (options.coordinator or _detected())
    ):
        return
    try:
        jax.distributed.initialize(options.coordinator, options.num_processes, options.process_id)
    except (RuntimeError, ValueError) as reason:
        where = options.coordinator or "found by JAX"
        why = str(reason).partition("\n")[0][:300]
        raise ConfigError(
            f"coordinator {where}: must be where all processes of the run meet ({why})",
            "coordinator",
        ) from reason


def _detected() -> bool:
    """Whether a scheduler started several processes of this program: Slurm, Open MPI, Kubernetes (an indexed job) or a TPU pod."""
    several = any(
        int(os.environ.get(name) or 1) > 1 for name in ("SLURM_NTASKS", "OMPI_COMM_WORLD_SIZE")
    )
    pod = "," in os.environ.get("TPU_WORKER_HOSTNAMES", "")
    return several or pod or {"KUBERNETES_SERVICE_HOST", "JOB_COMPLETION_INDEX"} <= set(os.environ)


def alone() -> bool:
    """Whether no other process shares the run."""
    return jax.process_count() == 1


def is_first() -> bool:
    """Whether this is the process that writes."""
    return jax.process_index() == 0


def first(value: int) -> int:
    """The first process's value; every process must ask."""
    return value if alone() else int(multihost_utils.broadcast_one_to_all(np.int32(value)))


def most(value: int) -> int:
    """The largest value of any process; every process must ask."""
    return value if alone() else int(multihost_utils.process_allgather(np.int32(value)).max())


def whole(tree: Any) -> Any:
    """The arrays of a tree on this host, where devices of other processes may hold parts of them; every process must ask."""

    def one(x: Any) -> np.ndarray:
        if isinstance(x, jax.Array) and not (x.is_fully_addressable or x.is_fully_replicated):
            x = multihost_utils.process_allgather(x, tiled=True)
        return np.asarray(x)

    return jax.tree.map(one, tree)


@contextlib.contextmanager
def writing(run_dir: Path) -> Iterator[Path]:
    """The directory that this process writes: the run's own, or for all but the first a copy of what there is, which goes at the end."""
    if is_first():
        _meet()
        yield run_dir
        return
    with tempfile.TemporaryDirectory(prefix="dgae_jax-") as scratch, terminal.silenced():
        mine = Path(scratch) / "run"
        if run_dir.exists():
            shutil.copytree(run_dir, mine)
        _meet()
        yield mine


def _meet() -> None:
    if not alone():
        multihost_utils.sync_global_devices("dgae_jax")
