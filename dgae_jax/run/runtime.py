"""Compiling, which may take minutes inside XLA, while this process still listens."""

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
from dgae_jax.physics.cores import cores
from dgae_jax.physics.registry import ENGINES
from dgae_jax.run import terminal
from dgae_jax.run.options import RunOptions

Watch = Callable[[str], None]
"""Told, now and then, what is going on; what it raises breaks it off."""

LOOK_EVERY = 0.5
"""Seconds between looks at the compiler."""

COMPILER_THREAD = "dgae_jax compiler"


def unwatched(_: str) -> None:
    """Tell nobody."""


def compile_in_thread(
    program: Any, *args: Any, watch: Watch = unwatched, what: str = "compiling"
) -> None:
    """Compile a jitted function for such arguments, so that calling it does not; in a thread, while this one waits.

    Python runs no signal handler as long as its main thread is inside of XLA. An exception that `watch` raises leaves the
    compiler to itself: it cannot be broken off, and holds up or aborts the end of the process unless that is `os._exit`.
    """
    since, done = time.monotonic(), Future()
    watch(what)
    lowered = program.lower(*args)  # here, where settings of this thread hold

    def work():
        try:
            done.set_result(lowered.compile())
        except BaseException as reason:
            done.set_exception(reason)

    threading.Thread(target=work, daemon=True, name=COMPILER_THREAD).start()
    while True:
        try:
            done.result(LOOK_EVERY)
            return
        except TimeoutError:
            if done.done():
                raise
            watch(f"{what}, {time.monotonic() - since:.0f} s")


def is_compiling() -> bool:
    """Whether a compiler was left to itself and has not finished."""
    return any(
        thread.name == COMPILER_THREAD and thread.is_alive() for thread in threading.enumerate()
    )


def join_processes(options: RunOptions) -> None:
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


def is_alone() -> bool:
    """Whether no other process shares the run."""
    return jax.process_count() == 1


def is_first() -> bool:
    """Whether this is the process that writes."""
    return jax.process_index() == 0


def of_first(value: int) -> int:
    """The first process's value; every process must ask."""
    return value if is_alone() else int(multihost_utils.broadcast_one_to_all(np.int32(value)))


def largest(value: int) -> int:
    """The largest value of any process; every process must ask."""
    return value if is_alone() else int(multihost_utils.process_allgather(np.int32(value)).max())


def gather(tree: Any) -> Any:
    """The arrays of a tree on this host, where devices of other processes may hold parts of them; every process must ask."""

    def one(x: Any) -> np.ndarray:
        if isinstance(x, jax.Array) and not (x.is_fully_addressable or x.is_fully_replicated):
            x = multihost_utils.process_allgather(x, tiled=True)
        return np.asarray(x)

    return jax.tree.map(one, tree)


@contextlib.contextmanager
def writing_directory(run_dir: Path) -> Iterator[Path]:
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
    if not is_alone():
        multihost_utils.sync_global_devices("dgae_jax")


SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, a scheduler, and a terminal that was closed."""


class Stopped(Exception):
    """A signal arrived where nothing is lost by stopping at once."""


class Signals:
    """Notes the first signal, so that the running dispatch can finish; a second one ends the process at once.

    A second SIGHUP does not: a terminal that closes may send several, and systemd sends one after SIGTERM. SIGHUP stays
    ignored where it was (`nohup`). Outside of the main thread Python has no signals, and none are noted.
    """

    def __init__(self):
        self.received: signal.Signals | None = None
        self.agreed = False
        self.before: dict[signal.Signals, Any] = {}
        self.nothing_to_lose = False

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            noted = [
                kind
                for kind in SIGNALS
                if kind != signal.SIGHUP or signal.getsignal(kind) != signal.SIG_IGN
            ]
            self.before = {kind: signal.signal(kind, self._note) for kind in noted}
        return self

    def __exit__(self, *_) -> None:
        for kind, handler in self.before.items():
            signal.signal(kind, handler)

    @contextlib.contextmanager
    def may_stop(self, watch: Watch = unwatched) -> Iterator[Watch]:
        """Around work that may be broken off: raises `Stopped` if a signal has arrived, as does the watch that it gives, later.

        The handler itself raises nothing: it may interrupt an import or a destructor of anybody's, which would lose the exception or
        keep a lock. Of several processes none can be broken off alone: there only what all have agreed on counts.
        """

        def heeding(text: str) -> None:
            self._stop()
            watch(text)

        self.nothing_to_lose = is_alone() or self.agreed
        try:
            self._stop()
            yield heeding
        finally:
            self.nothing_to_lose = False

    def anywhere(self) -> bool:
        """Whether a signal has come to any process of the run; every process must ask."""
        kind = largest(self.received or 0)
        if kind:
            self.received, self.agreed = signal.Signals(kind), True
        return self.agreed

    @property
    def name(self) -> str:
        """Of the signal that came: SIGINT, SIGTERM or SIGHUP."""
        return self.received.name if self.received else ""

    @property
    def exit_code(self) -> int:
        """130 after SIGINT, 143 after SIGTERM, 129 after SIGHUP."""
        return 128 + (self.received or 0)

    def _stop(self) -> None:
        if self.received and self.nothing_to_lose:
            raise Stopped

    def _note(self, kind: int, _) -> None:
        self.received = signal.Signals(kind)
        for each in self.before:
            signal.signal(each, signal.SIG_IGN if each == signal.SIGHUP else signal.SIG_DFL)
        if self.nothing_to_lose:
            return
        with contextlib.suppress(OSError):  # no print: it may be what was interrupted
            os.write(
                2,
                f"{self.name}: finishing what is running, then saving; a second signal ends it at once\n".encode(),
            )


_SETTINGS = (
    "jax_enable_x64",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_default_matmul_precision",
)
"""Of JAX, which the environment may change and on which the bits depend."""


ENVS_PER_CORE = 16
"""Fewer are stepped no faster: at that number every operation takes as long as its start."""


def use_devices(config: ResolvedConfig, options: RunOptions) -> int:
    """Start JAX, together with the other processes of the run, and the number of devices of each process that share it.

    Raises ConfigError if there is none of the kind asked for, or they are not there or do not divide worlds or seeds.
    """
    join_processes(options)
    wanted = _wanted(config, options)
    with contextlib.suppress(RuntimeError):  # JAX runs already, and has the devices that it has
        divide_cpu(wanted or _dividing(config, cores(), ENVS_PER_CORE))
    _start(config)
    there, processes = jax.local_device_count(), jax.process_count()
    if wanted is None and processes == 1:
        return _dividing(config, there, ENVS_PER_CORE if jax.default_backend() == "cpu" else 1)
    count = wanted or there
    if count > there:
        raise invalid(
            "devices",
            count,
            f"at most {there}, which JAX has here (a CPU is divided before JAX starts)",
        )
    if count < there and processes > 1:
        raise invalid(
            "devices",
            count,
            f"left out with several processes, each of which uses all of its {there}",
        )
    if _dividing(config, count * processes, 1) != count * processes:
        many = f" in each of {processes} processes" if processes > 1 else ""
        raise invalid(
            "devices",
            count,
            f"a number that divides num_envs {config.num_envs} or num_seeds {config.num_seeds}{many}",
        )
    return count


def _wanted(config: ResolvedConfig, options: RunOptions) -> int | None:
    """The number of devices that is asked for; a task whose worlds live in this process has one."""
    if not spec_of(config.env).on_host:
        return options.devices
    for name, value in (("devices", options.devices), ("num_processes", jax.process_count())):
        if value not in (None, 1):
            raise invalid(
                name,
                value,
                f"1 with {config.env}, whose worlds are stepped one after the other in one process",
            )
    return 1


def _dividing(config: ResolvedConfig, most: int, worlds_each: int) -> int:
    """The largest number of devices up to `most` between which seeds or worlds can be divided evenly."""

    def fits(count: int) -> bool:
        seeds = config.num_seeds > 1 and config.num_seeds % count == 0
        return seeds or (config.num_envs % count == 0 and config.num_envs >= count * worlds_each)

    return next((count for count in range(most, 1, -1) if fits(count)), 1)


def _start(config: ResolvedConfig) -> None:
    try:
        kind = jax.devices()[0].platform
    except (
        Exception
    ) as reason:  # JAX raises many kinds, an AssertionError without a word for a missing plugin
        wanted, why = os.environ.get("JAX_PLATFORMS", ""), str(reason) or type(reason).__name__
        gpu = "" if wanted == "cpu" else 'an NVIDIA GPU needs pip install "dgae_jax[cuda13]"; '
        raise ConfigError(
            f"JAX_PLATFORMS={wanted}: must name a device that JAX finds here, cpu for one; {gpu}JAX says: {why}"
        ) from reason
    if spec_of(config.env).on_host and kind != "cpu":
        raise ConfigError(
            f"JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS', '')}: must be cpu with {config.env}; JAX is on the {kind}"
        )
    if kind != "cpu" and config.physics in ENGINES and ENGINES[config.physics].on_host:
        terminal.warn(
            f"warning: --physics {config.physics} simulates on the CPU and everything else runs on the {kind}, so that each step crosses"
            f" between them; --physics jax or JAX_PLATFORMS=cpu keeps all in one place"
        )


def use_cache(cache_dir: str) -> None:
    """Keep compiled programs in `cache_dir`, or nowhere if it is "none"; raises ConfigError if it cannot be written."""
    if cache_dir == "none":
        jax.config.update("jax_enable_compilation_cache", False)
        return
    try:
        path = Path(cache_dir).expanduser()
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError) as reason:
        raise invalid(
            "cache_dir", cache_dir, f"a directory that can be written, or none ({reason})"
        ) from reason
    jax.config.update("jax_compilation_cache_dir", str(path))


def hardware() -> dict[str, Any]:
    """What of the machine decides how numbers are rounded."""
    return {
        "device": f"{jax.default_backend()}: {_model()}",
        "cores": _cores(),
        "processes": jax.process_count(),
        "settings": {name: getattr(jax.config, name, None) for name in _SETTINGS}
        | {"XLA_FLAGS": os.environ.get("XLA_FLAGS")},
    }


def _model() -> str:
    """Of the device; JAX calls every CPU the same, but compiles for the one it finds."""
    if jax.default_backend() != "cpu":
        return jax.devices()[0].device_kind
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(
            line.partition(":")[2].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _cores() -> int | None:
    """Cores this process may use: on a CPU their number decides how sums are split, and so their rounding."""
    if jax.default_backend() != "cpu":
        return None
    return cores()


def available_memory() -> int:
    """Bytes that a run may take: of the device, or of this machine or the control group that this process is in."""
    limit = (
        (jax.devices()[0].memory_stats() or {}).get("bytes_limit")
        if jax.default_backend() != "cpu"
        else None
    )
    if limit:
        return int(limit)
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        return min(total, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):  # no control groups, or no limit
        return total
