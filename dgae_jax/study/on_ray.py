"""Cells as tasks of a Ray cluster whose nodes share the study's directory.

A task whose node dies is begun again on another, and continues from the checkpoint of its cell.
"""

import contextlib
import logging
import socket
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import Any

from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.study.work import Job, run

REACH_SECONDS = 5.0
"""How long a cluster may take to answer."""


def check(address: str | None) -> None:
    """Raise ConfigError if Ray is not installed or nobody answers at the address."""
    named = address not in (None, "auto", "local")
    host, _, port = str(address).removeprefix("ray://").rpartition(":")
    if named and not (host and port.isdigit()):
        raise invalid("address", address, "HOST:PORT of a cluster, or auto")
    if not find_spec("ray"):
        raise invalid("launcher", "ray", 'used with Ray installed: pip install "dgae_jax[ray]"')
    if named:
        try:
            with socket.create_connection((host, int(port)), REACH_SECONDS):
                pass
        except (OSError, OverflowError) as reason:
            raise invalid("address", address, f"where a Ray cluster answers ({reason})") from reason


@contextlib.contextmanager
def launch(jobs: Sequence[Job], options: Any) -> Iterator[dict[Any, Job]]:
    """All jobs as tasks; leaving it gives up those that are not done, and their cells stop with a checkpoint."""
    import ray  # pyright: ignore[reportMissingImports]

    try:
        ray.init(
            options.address or "local",
            log_to_driver=False,
            logging_level=logging.ERROR,
            ignore_reinit_error=True,
        )
    except (ConnectionError, RuntimeError, ValueError) as reason:
        raise ConfigError(
            f"address {options.address}: must be where a Ray cluster answers ({_line(reason)})",
            "address",
        ) from reason
    task = ray.remote(num_cpus=options.cpus_per_run, num_gpus=options.gpus_per_run, max_retries=-1)(
        run
    )
    try:
        yield {task.remote(job).future(): job for job in jobs}
    finally:
        ray.shutdown()


def _line(reason: Exception) -> str:
    return str(reason).partition("\n")[0][:200]
