"""What several commands check: which of the trained seeds, the seed of episodes, and where they write."""

import os
from pathlib import Path

from dgae_jax.configs.config import invalid
from dgae_jax.configs.resolved import ResolvedConfig


def check_index(index: int, config: ResolvedConfig, source: Path) -> None:
    """Raise ConfigError unless so many seeds were trained side by side."""
    if not 0 <= index < config.num_seeds:
        raise invalid(
            "index",
            index,
            f"a whole number from 0 to {config.num_seeds - 1}, the index of a seed in {source}",
        )


def check_seed(seed: int) -> None:
    """Raise ConfigError unless the seed of episodes is one."""
    if not 0 <= seed < 2**31:
        raise invalid("seed", seed, f"a whole number from 0 to {2**31 - 1:,} (an int32)")


def check_file(out: Path) -> None:
    """Raise ConfigError unless a file can be written there, as far as can be seen."""
    try:
        there, is_file = (
            out.absolute().parent.is_dir(),
            not out.is_symlink() and (out.is_file() or not out.exists()),
        )
    except (
        OSError
    ) as reason:  # the name is too long, or lies behind a directory that may not be read
        raise invalid("out", out, f"a file that can be written ({reason.strerror})") from reason
    if not there:
        raise invalid("out", out, "a file in a directory that exists")
    if not is_file:
        raise invalid("out", out, "a file, not a directory, a link or a device")
    if not os.access(out.absolute().parent, os.W_OK):
        raise invalid("out", out, "a file that can be written")


def check_directory(out: Path) -> None:
    """Raise ConfigError unless a directory that can be written is there, or can be made, as far as can be seen from what exists."""
    try:
        above = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    except OSError as reason:  # as above
        raise invalid(
            "out", out, f"a directory that can be written ({reason.strerror})"
        ) from reason
    if not (above.is_dir() and os.access(above, os.W_OK)):
        raise invalid("out", out, "a directory that can be written")
