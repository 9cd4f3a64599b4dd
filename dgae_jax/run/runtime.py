"""The machine under a run: devices, processes, signals and the compiler.

Several processes, on one host or many, may share a run: all compute, the first one writes. What
decides the course of a run, clock and signals, is agreed on, so that all make the same calls.
"""

import contextlib
import os
import platform
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import spec_of
from dgae_jax.learn.devices import divide_cpu
from dgae_jax.physics import cores
from dgae_jax.run import terminal
from dgae_jax.run.options import RunOptions

Watch = Callable[[str], None]
"""Called repeatedly with a line of progress; what it raises breaks the work off."""

POLL_SECONDS = 0.5
"""Time between looks at the compiler."""

COMPILER_THREAD = "dgae_jax compiler"

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, a scheduler, and a terminal that was closed."""

ENVS_PER_CORE = 16
"""Fewer are stepped no faster: at that number every operation takes as long as its start."""

JAX_SETTINGS = (
    "jax_enable_x64",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_default_matmul_precision",
)
"""Settings that the environment may change and on which the bits of a run depend."""


def unwatched(_: str) -> None:
    """Ignore progress."""


def compile_in_thread(
    program: Any, *args: Any, watch: Watch = unwatched, what: str = "compiling"
) -> None:
    """Compile a jitted function for these arguments, in a thread, while this one stays responsive.

    Python runs no signal handler while its main thread is inside XLA. A compiler that `watch`
    breaks off keeps running; the end of the process waits for it unless that is `os._exit`.
    """
    since = time.monotonic()
    watch(what)
    lowered = program.lower(*args)  # here: JAX's settings belong to a thread
    thread = ThreadPoolExecutor(1, COMPILER_THREAD)
    done = thread.submit(lowered.compile)
    thread.shutdown(wait=False)
    while wait([done], POLL_SECONDS).not_done:
        watch(f"{what}, {time.monotonic() - since:.0f} s")
    done.result()


def is_compiling() -> bool:
    """Return whether a compiler that was broken off still runs."""
    return any(thread.name.startswith(COMPILER_THREAD) for thread in threading.enumerate())


def join_processes(options: RunOptions) -> None:
    """Meet the other processes of the run, if there are any.

    Raises:
        ConfigError: they do not come.
    """
    given = options.coordinator, options.num_processes, options.process_id
    several = given != (None, None, None) or _under_scheduler()
    if jax.distributed.is_initialized() or options.num_processes == 1 or not several:
        return
    try:
        jax.distributed.initialize(*given)
    except Exception as reason:  # of many kinds
        where = options.coordinator or "found by JAX"
        why = str(reason).partition("\n")[0][:300]
        must = f"must be HOST:PORT where all processes meet ({why})"
        raise ConfigError(f"coordinator {where}: {must}", "coordinator") from reason


def _under_scheduler() -> bool:
    """Return whether Slurm, Open MPI, Kubernetes or a TPU pod started several processes."""
    sizes = (os.environ.get(name) or 1 for name in ("SLURM_NTASKS", "OMPI_COMM_WORLD_SIZE"))
    pod = "," in os.environ.get("TPU_WORKER_HOSTNAMES", "")
    job = {"KUBERNETES_SERVICE_HOST", "JOB_COMPLETION_INDEX"} <= set(os.environ)
    return any(int(size) > 1 for size in sizes) or pod or job


def largest(value: int) -> int:
    """Return the largest value of any process; every process must call."""
    return int(multihost_utils.process_allgather(np.int32(value)).max())


def gather(tree: Any) -> Any:
    """Return a tree's arrays on this host, also parts on other hosts; every process must call."""

    def one(x: Any) -> np.ndarray:
        here = not isinstance(x, jax.Array) or x.is_fully_addressable
        return np.asarray(x if here else multihost_utils.process_allgather(x, tiled=True))

    return jax.tree.map(one, tree)


@contextlib.contextmanager
def writing_directory(run_dir: Path) -> Iterator[Path]:
    """Yield the directory that this process writes: all but the first write a temporary copy."""
    if jax.process_index() == 0:
        multihost_utils.sync_global_devices("copied")
        yield run_dir
        return
    with tempfile.TemporaryDirectory(prefix="dgae_jax-") as scratch, terminal.silenced():
        copy = Path(scratch) / "run"
        if run_dir.exists():
            shutil.copytree(run_dir, copy)
        multihost_utils.sync_global_devices("copied")
        yield copy


class Stopped(Exception):
    """A signal arrived where nothing is lost by stopping at once."""


class Signals:
    """Record the first stop signal, so that the running dispatch can finish.

    A second signal ends the process at once, but for SIGHUP: a terminal that closes may send
    several, and systemd sends one after SIGTERM. SIGHUP stays ignored where it was (`nohup`).
    Outside the main thread Python has no signals.
    """

    def __init__(self):
        self.received: Any = None
        """SIGINT, SIGTERM or SIGHUP, once it has arrived."""
        self.agreed = False
        self.before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
            kinds = [kind for kind in SIGNALS if not (kind == signal.SIGHUP and ignored)]
            self.before = {kind: signal.signal(kind, self._record) for kind in kinds}
        return self

    def __exit__(self, *_) -> None:
        for kind, handler in self.before.items():
            signal.signal(kind, handler)

    def watching(self, watch: Watch = unwatched) -> Watch:
        """Return a watch that raises `Stopped` once a signal has arrived.

        The handler itself raises nothing: it may interrupt an import or a destructor. Of several
        processes none can stop alone: there only a signal that all have agreed on counts.
        """

        def checked(text: str) -> None:
            if self.received and (self.agreed or jax.process_count() == 1):
                raise Stopped
            watch(text)

        return checked

    def anywhere(self) -> bool:
        """Return whether any process of the run got a signal; every process must call."""
        kind = largest(self.received or 0)
        if kind:
            self.received, self.agreed = signal.Signals(kind), True
        return self.agreed

    def _record(self, kind: int, _) -> None:
        self.received = signal.Signals(kind)
        for each in self.before:
            signal.signal(each, signal.SIG_IGN if each == signal.SIGHUP else signal.SIG_DFL)
        text = f"{self.received.name}: stopping; a second signal ends the process at once\n"
        with contextlib.suppress(OSError):  # no print: it may be what was interrupted
            os.write(2, text.encode())


def use_devices(config: ResolvedConfig, options: RunOptions) -> int:
    """Start JAX, join the other processes, and return how many devices each process uses.

    Raises:
        ConfigError: the devices do not exist, or do not divide the envs or the seeds.
    """
    join_processes(options)
    on_host = spec_of(config.env).on_host
    wanted = 1 if on_host and options.devices is None else options.devices
    with contextlib.suppress(RuntimeError):  # JAX runs already, and has the devices that it has
        divide_cpu(wanted or _dividing(config, cores(), ENVS_PER_CORE))
    try:
        backend = jax.default_backend()
    except Exception as reason:  # of many kinds; an empty AssertionError for a missing plugin
        given = f"JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS', '')}"
        why = f"must name a device that JAX finds here ({str(reason) or type(reason).__name__})"
        gpu = 'an NVIDIA GPU needs pip install "dgae_jax[cuda13]"'
        raise ConfigError(f"{given}: {why}; {gpu}") from reason
    there, processes = jax.local_device_count(), jax.process_count()
    if on_host and (wanted, processes, backend) != (1, 1, "cpu"):
        limit = f"1, in one process with JAX_PLATFORMS=cpu, with {config.env}"
        raise invalid("devices", wanted, limit)
    if wanted is None and processes == 1:
        return _dividing(config, there, ENVS_PER_CORE if backend == "cpu" else 1)
    count = wanted or there
    if count > there or (count < there and processes > 1):
        limit = f"at most {there}, which JAX has started with, and all with several processes"
        raise invalid("devices", count, limit)
    if _dividing(config, count * processes, 1) != count * processes:
        sizes = f"num_envs {config.num_envs} or num_seeds {config.num_seeds}"
        many = f" in each of {processes} processes" if processes > 1 else ""
        raise invalid("devices", count, f"a number that divides {sizes}{many}")
    return count


def _dividing(config: ResolvedConfig, most: int, envs_each: int) -> int:
    """Return the largest number of devices up to `most` that divides seeds or envs evenly."""
    for count in range(most, 1, -1):
        seeds = config.num_seeds > 1 and config.num_seeds % count == 0
        if seeds or (config.num_envs % count == 0 and config.num_envs >= count * envs_each):
            return count
    return 1


def use_cache(cache_dir: str) -> None:
    """Keep compiled programs in `cache_dir`, or nowhere if it is "none"."""
    jax.config.update("jax_enable_compilation_cache", cache_dir != "none")
    jax.config.update("jax_compilation_cache_dir", str(Path(cache_dir).expanduser()))


def hardware() -> dict[str, Any]:
    """Return what decides how numbers are rounded: device, cores, processes, JAX's settings."""
    on_cpu = jax.default_backend() == "cpu"
    settings = {name: getattr(jax.config, name, None) for name in JAX_SETTINGS}
    return {
        "device": f"{jax.default_backend()}: {_device_model()}",
        "cores": cores() if on_cpu else None,  # their number decides how sums are split
        "processes": jax.process_count(),
        "settings": settings | {"XLA_FLAGS": os.environ.get("XLA_FLAGS")},
    }


def _device_model() -> str:
    """Return the model; JAX has one name for all CPUs, but compiles for the one it finds."""
    if jax.default_backend() != "cpu":
        return jax.devices()[0].device_kind
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def available_memory() -> int:
    """Return the bytes that a run may take: of the device, or of the machine or control group."""
    if jax.default_backend() != "cpu":
        limit = (jax.devices()[0].memory_stats() or {}).get("bytes_limit")
        if limit:
            return int(limit)
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        return min(total, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):  # no control groups, or no limit
        return total
