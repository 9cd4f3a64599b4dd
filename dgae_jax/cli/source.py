"""Where a command finds a trained policy: a run directory, or the file of a policy."""

from pathlib import Path

from dgae_jax.configs.config import Config, ConfigError, invalid
from dgae_jax.run import directory


def config_of(source: Path) -> Config:
    """The configuration of the run, without loading JAX where it can be had without, and never MuJoCo, which a film must do without until
    its OpenGL is chosen; raises as `restore.config_of`, and ConfigError for a path that cannot be looked at.
    """
    try:
        is_file = source.is_file()
    except OSError as reason:
        raise ConfigError(f"{source}: must be a run directory, or the file of a policy ({reason.strerror})") from reason
    if not is_file:
        return directory.read_config(source)
    from dgae_jax.run import checkpoint

    return checkpoint.config_of(source)


def check_index(index: int, config: Config, source: Path) -> None:
    """Raise ConfigError unless so many seeds were trained side by side."""
    if not 0 <= index < config.num_seeds:
        raise invalid("index", index, f"a whole number from 0 to {config.num_seeds - 1}, the index of a seed in {source}")


def check_seed(seed: int) -> None:
    """Raise ConfigError unless the seed of episodes is one."""
    if not 0 <= seed < 2**31:
        raise invalid("seed", seed, f"a whole number from 0 to {2**31 - 1:,} (an int32)")


def check_file(out: Path) -> None:
    """Raise ConfigError unless a file can be written there, as far as can be seen."""
    try:
        there, is_file = out.absolute().parent.is_dir(), not out.is_symlink() and (out.is_file() or not out.exists())
    except OSError as reason:  # the name is too long, or lies behind a directory that may not be read
        raise invalid("out", out, f"a file that can be written ({reason.strerror})") from reason
    if not there:
        raise invalid("out", out, "a file in a directory that exists")
    if not is_file:
        raise invalid("out", out, "a file, not a directory, a link or a device")
