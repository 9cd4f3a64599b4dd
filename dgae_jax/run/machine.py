"""The machine a run is on."""

import os
from pathlib import Path

import jax

from dgae_jax.configs.config import Config, ConfigError
from dgae_jax.run import terminal


def use_device(config: Config) -> None:
    """Start JAX on its device; raises ConfigError if there is none of the kind asked for."""
    try:
        platform = jax.devices()[0].platform
    except Exception as reason:  # JAX raises many kinds, an AssertionError without a word for a missing plugin
        wanted, why = os.environ.get("JAX_PLATFORMS", ""), str(reason) or type(reason).__name__
        gpu = "" if wanted == "cpu" else 'an NVIDIA GPU needs pip install "dgae_jax[cuda13]"; '
        raise ConfigError(f"JAX_PLATFORMS={wanted}: must name a device that JAX finds here, cpu for one; {gpu}JAX says: {why}") from reason
    if config.physics == "native" and platform != "cpu":
        terminal.warn(
            f"warning: --physics native simulates on the CPU and everything else runs on the {platform}, so that each step crosses"
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
        raise ConfigError(f"--cache-dir {cache_dir}: must be a directory that can be written, or none ({reason})") from reason
    jax.config.update("jax_compilation_cache_dir", str(path))
