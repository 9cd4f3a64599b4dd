"""Where a policy can be evaluated."""

from dgae_jax.configs.config import invalid
from dgae_jax.configs.resolved import ResolvedConfig
from dgae_jax.envs.registry import spec_of


def engines_of(config: ResolvedConfig) -> tuple[str, ...]:
    """Where a run can be evaluated, the referee first: Gymnasium for our tasks and its own, the run's own physics for any other."""
    spec = spec_of(config.env)
    return ("gymnasium", *spec.engines) if spec.referees else spec.engines


def engine_of(config: ResolvedConfig, engine: str | None, setting: str = "engine") -> str:
    """The engine of that name, the first of `engines_of` where there is none; raises ConfigError if the run cannot have it.

    `setting` is what the name was given as.
    """
    if engine is not None and engine not in engines_of(config):
        raise invalid(setting, engine, f"one of {', '.join(engines_of(config))} with {config.env}")
    return engine or engines_of(config)[0]


def referee(config: ResolvedConfig) -> str:
    """Gymnasium's name of the task, or ours where Gymnasium does not play it."""
    return spec_of(config.env).referee(config.env_version) or config.env
