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
from concurrent.futures import Future
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
from dgae_jax.physics.registry import ENGINES
from dgae_jax.run import terminal
from dgae_jax.run.options import RunOptions

Watch = Callable[[str], None]
"""Called now and then with a line of progress; what it raises breaks the work off."""

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
    breaks off keeps running, and aborts the end of the process unless that is `os._exit`.
    """
    since, done = time.monotonic(), Future()
    watch(what)
    lowered = program.lower(*args)  # here: JAX's settings belong to a thread

    def compile_lowered():
        try:
            done.set_result(lowered.compile())
        except BaseException as reason:
            done.set_exception(reason)

    threading.Thread(target=compile_lowered, daemon=True, name=COMPILER_THREAD).start()
    while True:
        try:
            done.result(POLL_SECONDS)
            return
        except TimeoutError:
            if done.done():
                raise
            watch(f"{what}, {time.monotonic() - since:.0f} s")


def is_compiling() -> bool:
    """Return whether a compiler that was broken off still runs."""
    return any(t.name == COMPILER_THREAD and t.is_alive() for t in threading.enumerate())


def join_processes(options: RunOptions) -> None:
    """Meet the other processes of the run, if there are any.

    Raises:
        ConfigError: they do not come.
    """
    several = options.coordinator or _under_scheduler()
    if jax.distributed.is_initialized() or options.num_processes == 1 or not several:
        return
    try:
        jax.distributed.initialize(options.coordinator, options.num_processes, options.process_id)
    except (RuntimeError, ValueError) as reason:
        where = options.coordinator or "found by JAX"
        why = str(reason).partition("\n")[0][:300]
        message = f"coordinator {where}: must be where all processes of the run meet ({why})"
        raise ConfigError(message, "coordinator") from reason


def _under_scheduler() -> bool:
    """Return whether Slurm, Open MPI, Kubernetes or a TPU pod started several processes."""
    sizes = (os.environ.get(name) or 1 for name in ("SLURM_NTASKS", "OMPI_COMM_WORLD_SIZE"))
    pod = "," in os.environ.get("TPU_WORKER_HOSTNAMES", "")
    job = {"KUBERNETES_SERVICE_HOST", "JOB_COMPLETION_INDEX"} <= set(os.environ)
    return any(int(size) > 1 for size in sizes) or pod or job


def is_alone() -> bool:
    """Return whether no other process shares the run."""
    return jax.process_count() == 1


def is_first() -> bool:
    """Return whether this is the process that writes."""
    return jax.process_index() == 0


def of_first(value: int) -> int:
    """Return the first process's value; every process must call."""
    return value if is_alone() else int(multihost_utils.broadcast_one_to_all(np.int32(value)))


def largest(value: int) -> int:
    """Return the largest value of any process; every process must call."""
    return value if is_alone() else int(multihost_utils.process_allgather(np.int32(value)).max())


def gather(tree: Any) -> Any:
    """Return a tree's arrays on this host, also parts on other hosts; every process must call."""

    def one(x: Any) -> np.ndarray:
        if isinstance(x, jax.Array) and not (x.is_fully_addressable or x.is_fully_replicated):
            x = multihost_utils.process_allgather(x, tiled=True)
        return np.asarray(x)

    return jax.tree.map(one, tree)


@contextlib.contextmanager
def writing_directory(run_dir: Path) -> Iterator[Path]:
    """Yield the directory that this process writes: all but the first write a temporary copy."""
    if is_first():
        _barrier()
        yield run_dir
        return
    with tempfile.TemporaryDirectory(prefix="dgae_jax-") as scratch, terminal.silenced():
        copy = Path(scratch) / "run"
        if run_dir.exists():
            shutil.copytree(run_dir, copy)
        _barrier()
        yield copy


def _barrier() -> None:
    if not is_alone():
        multihost_utils.sync_global_devices("dgae_jax")


class Stopped(Exception):
    """A signal arrived while nothing is lost by stopping at once."""


class Signals:
    """Record the first stop signal, so that the running dispatch can finish.

    A second signal ends the process at once, but for SIGHUP: a terminal that closes may send
    several, and systemd sends one after SIGTERM. SIGHUP stays ignored where it was (`nohup`).
    Outside the main thread Python has no signals.
    """

    def __init__(self):
        self.received: signal.Signals | None = None
        self.agreed = False
        self.before: dict[signal.Signals, Any] = {}
        self.nothing_to_lose = False

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
            kinds = [kind for kind in SIGNALS if not (kind == signal.SIGHUP and ignored)]
            self.before = {kind: signal.signal(kind, self._record) for kind in kinds}
        return self

    def __exit__(self, *_) -> None:
        for kind, handler in self.before.items():
            signal.signal(kind, handler)

    @contextlib.contextmanager
    def may_stop(self, watch: Watch = unwatched) -> Iterator[Watch]:
        """Raise `Stopped` if a signal has arrived; so does the watch that it yields, later.

        The handler raises nothing: it may interrupt an import or a destructor. Of several
        processes none can stop alone: there only a signal that all have agreed on counts.
        """

        def checked(text: str) -> None:
            self._stop()
            watch(text)

        self.nothing_to_lose = is_alone() or self.agreed
        try:
            self._stop()
            yield checked
        finally:
            self.nothing_to_lose = False

    def anywhere(self) -> bool:
        """Return whether any process of the run got a signal; every process must call."""
        kind = largest(self.received or 0)
        if kind:
            self.received, self.agreed = signal.Signals(kind), True
        return self.agreed

    @property
    def name(self) -> str:
        """SIGINT, SIGTERM or SIGHUP."""
        return self.received.name if self.received else ""

    @property
    def exit_code(self) -> int:
        """130 after SIGINT, 143 after SIGTERM, 129 after SIGHUP."""
        return 128 + (self.received or 0)

    def _stop(self) -> None:
        if self.received and self.nothing_to_lose:
            raise Stopped

    def _record(self, kind: int, _) -> None:
        self.received = signal.Signals(kind)
        for each in self.before:
            signal.signal(each, signal.SIG_IGN if each == signal.SIGHUP else signal.SIG_DFL)
        if self.nothing_to_lose:
            return
        text = "finishing the running dispatch, then saving; a second signal ends the run at once"
        with contextlib.suppress(OSError):  # no print: it may be what was interrupted
            os.write(2, f"{self.name}: {text}\n".encode())


def use_devices(config: ResolvedConfig, options: RunOptions) -> int:
    """Start JAX, join the other processes, and return how many devices each process uses.

    Raises:
        ConfigError: the devices do not exist, or do not divide the envs or the seeds.
    """
    join_processes(options)
    wanted = _requested(config, options)
    with contextlib.suppress(RuntimeError):  # JAX runs already, and has the devices that it has
        divide_cpu(wanted or _dividing(config, cores(), ENVS_PER_CORE))
    _start_jax(config)
    there, processes = jax.local_device_count(), jax.process_count()
    if wanted is None and processes == 1:
        return _dividing(config, there, ENVS_PER_CORE if jax.default_backend() == "cpu" else 1)
    count = wanted or there
    if count > there:
        limit = f"at most {there}, which JAX has here (a CPU is divided before JAX starts)"
        raise invalid("devices", count, limit)
    if count < there and processes > 1:
        raise invalid("devices", count, f"left out: each of several processes uses all {there}")
    if _dividing(config, count * processes, 1) != count * processes:
        sizes = f"num_envs {config.num_envs} or num_seeds {config.num_seeds}"
        many = f" in each of {processes} processes" if processes > 1 else ""
        raise invalid("devices", count, f"a number that divides {sizes}{many}")
    return count


def _requested(config: ResolvedConfig, options: RunOptions) -> int | None:
    """Return the number of devices asked for; envs on the host have one."""
    if not spec_of(config.env).on_host:
        return options.devices
    for name, value in (("devices", options.devices), ("num_processes", jax.process_count())):
        if value not in (None, 1):
            raise invalid(name, value, f"1 with {config.env}, which is stepped in one process")
    return 1


def _dividing(config: ResolvedConfig, most: int, envs_each: int) -> int:
    """Return the largest number of devices up to `most` that divides seeds or envs evenly."""

    def fits(count: int) -> bool:
        seeds = config.num_seeds > 1 and config.num_seeds % count == 0
        return seeds or (config.num_envs % count == 0 and config.num_envs >= count * envs_each)

    return next((count for count in range(most, 1, -1) if fits(count)), 1)


def _start_jax(config: ResolvedConfig) -> None:
    wanted = os.environ.get("JAX_PLATFORMS", "")
    try:
        kind = jax.devices()[0].platform
    except Exception as reason:  # of many kinds; an empty AssertionError for a missing plugin
        why = str(reason) or type(reason).__name__
        gpu = "" if wanted == "cpu" else 'an NVIDIA GPU needs pip install "dgae_jax[cuda13]"; '
        must = "must name a device that JAX finds here, cpu for one"
        raise ConfigError(f"JAX_PLATFORMS={wanted}: {must}; {gpu}JAX says: {why}") from reason
    if spec_of(config.env).on_host and kind != "cpu":
        raise ConfigError(f"JAX_PLATFORMS={wanted}: must be cpu with {config.env}, not {kind}")
    if kind != "cpu" and config.physics in ENGINES and ENGINES[config.physics].on_host:
        terminal.warn(
            f"warning: --physics {config.physics} simulates on the CPU, everything else runs on"
            f" the {kind}; --physics jax or JAX_PLATFORMS=cpu avoids the transfers"
        )


def use_cache(cache_dir: str) -> None:
    """Keep compiled programs in `cache_dir`, or nowhere if it is "none".

    Raises:
        ConfigError: it cannot be written.
    """
    if cache_dir == "none":
        jax.config.update("jax_enable_compilation_cache", False)
        return
    try:
        path = Path(cache_dir).expanduser()
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError) as reason:
        allowed = f"a directory that can be written, or none ({reason})"
        raise invalid("cache_dir", cache_dir, allowed) from reason
    jax.config.update("jax_compilation_cache_dir", str(path))


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
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(x.partition(":")[2].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
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
