"""Where a command finds a trained policy: a run directory, or the file of a policy."""

from pathlib import Path

from dgae_jax.configs.config import Config
from dgae_jax.run import directory


def config_of(source: Path) -> Config:
    """The configuration of the run, without loading JAX where it can be had without; raises as `restore.config_of`."""
    if not source.is_file():
        return directory.read_config(source)
    from dgae_jax.run import restore

    return restore.config_of(source)
