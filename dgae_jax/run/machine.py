"""The machine a run is on."""

import contextlib
import os
import platform
from pathlib import Path
from typing import Any

import jax

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import spec_of
from dgae_jax.learn.devices import divide_cpu
from dgae_jax.physics.cores import cores
from dgae_jax.physics.registry import ENGINES
from dgae_jax.run import hosts, terminal
from dgae_jax.run.options import RunOptions

_SETTINGS = (
    "jax_enable_x64",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_default_matmul_precision",
)
"""Of JAX, which the environment may change and on which the bits depend."""


WORLDS_PER_CORE = 16
"""Fewer are stepped no faster: at that number every operation takes as long as its start."""


def use_devices(config: ResolvedConfig, options: RunOptions) -> int:
    """Start JAX, together with the other processes of the run, and the number of devices of each process that share it.

    Raises ConfigError if there is none of the kind asked for, or they are not there or do not divide worlds or seeds.
    """
    hosts.join(options)
    wanted = _wanted(config, options)
    with contextlib.suppress(RuntimeError):  # JAX runs already, and has the devices that it has
        divide_cpu(wanted or _dividing(config, cores(), WORLDS_PER_CORE))
    _start(config)
    there, processes = jax.local_device_count(), jax.process_count()
    if wanted is None and processes == 1:
        return _dividing(config, there, WORLDS_PER_CORE if jax.default_backend() == "cpu" else 1)
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


def facts() -> dict[str, Any]:
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


def memory() -> int:
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
