"""Settings that belong together: `tuned` (ours) and `paper` (its set-up; docs/reproduction.md lists what it leaves open)."""

import dataclasses
from typing import Any

from dgae_jax.configs.algorithms import TABLE
from dgae_jax.configs.config import Config, lookup
from dgae_jax.configs.parts import CRITICS, UPDATES, is_distribution

Settings = dict[str, Any]
"""Fields of `Config`, nested dictionaries for its parts."""


def _tuned(update: str, critic: str, env: str) -> list[Settings]:
    """One setting per way to update; a task departs from it only where it must."""
    by_update: dict[str, Settings] = {
        "clip": {"num_envs": 64, "horizon": 32},
        "gradient": {
            "horizon": 32,
            "policy": {"optimizer": "rmsprop", "learning_rate": 7e-4, "epochs": 1, "minibatches": 16},
            "critic": {"learning_rate": 1e-3, "epochs": 5, "minibatches": 16},
        },
        "trust-region": {
            "gamma": 0.995,  # at 0.99 some seeds of Hopper hop faster and faster, and fall
            "policy": {"initial_std": 1.0, "radius": 0.03, "learning_rate_end": 0.0, "damping": 0.3, "cg_iterations": 25},
            "critic": {"learning_rate": 1e-3, "learning_rate_end": 1.0, "epochs": 20, "minibatches": 16},
        },
    }
    settings = [by_update.get(update, {})]
    if env == "hopper":  # with 0.99 a faster hop is worth a later fall, with narrow actions some seeds stand still
        settings += [{"gamma": 0.995, "policy": {"initial_std": 1.0}}, {"num_envs": 16, "horizon": 128} if update == "clip" else {}]
    if env == "ant":  # with a longer λ it learns later; with wide actions it falls before it has walked
        narrow: Settings = {"gamma": 0.99, "policy": {"initial_std": 0.5, "radius": 0.08}}  # a radius for 8 actions, not 3
        settings += [{"lam": 0.8}, narrow if update == "trust-region" else {}]
    if env == "swimmer":  # a stroke pays late: short rollouts do not see it, and with less λ or larger steps more seeds make half of it
        far: Settings = {"num_envs": 2, "horizon": 1024, "lam": 0.99, "policy": {"initial_std": 1.0}}
        small: Settings = {"policy": {"radius": 0.01}}
        settings += [{"gamma": 0.9999}, {} if update == "gradient" else far, small if update == "trust-region" else {}]
    return settings


def _paper(update: str, critic: str, env: str) -> list[Settings]:
    ant = env == "ant"
    hidden, constant = (512, 512) if ant else (256, 256), {"learning_rate_end": 1.0}
    quantile = {"quantiles": 64, "target": "bellman"} if is_distribution(critic) else {"target": "lambda-return"}
    networks: Settings = {
        "total_steps": 10_000_000 if env in ("ant", "hopper") else 5_000_000,
        "policy": {"hidden": hidden, "covariance": "state", "initial_std": 1.0},
        "critic": {"hidden": hidden, **quantile, **constant},
    }
    once = {"optimizer": "rmsprop", "learning_rate": 7e-4, "epochs": 1, "minibatches": 1, **constant}
    by_update: dict[str, Settings] = {
        "clip": {
            "horizon": 256 if ant else 128,
            "policy": {"minibatches": 64 if ant else 32, **constant},
            "critic": {"minibatches": 64 if ant else 32},
        },
        "trust-region": {
            "num_envs": 50 if ant else 25,
            "horizon": 1000,
            "critic": {"learning_rate": 1e-3, "minibatches": 500 if ant else 250},
        },
        "gradient": {"horizon": 5, "policy": once, "critic": once},
    }
    return [networks, by_update.get(update, {})]


PRESETS = {"tuned": _tuned, "paper": _paper}


def preset(name: str, algo: str, env: str, update: str | None = None, critic: str | None = None) -> Config:
    """The configuration of a preset for an algorithm on a task; `update` and `critic` take the place of the algorithm's own.

    Raises ConfigError for a name that does not exist.
    """
    settings, row = lookup("preset", name, PRESETS), lookup("algo", algo, TABLE)
    lookup("policy.update", update or row.policy_update, UPDATES)
    lookup("critic.kind", critic or row.critic, CRITICS)
    config = Config(env=env, algo=algo)
    config = _with(config, {"policy": {"update": update}, "critic": {"kind": critic}})
    for group in settings(update or row.policy_update, critic or row.critic, env):
        config = _with(config, group)
    return config


def _with(config: Any, settings: Settings) -> Any:
    parts = {k: _with(getattr(config, k), v) if isinstance(v, dict) else v for k, v in settings.items()}
    return dataclasses.replace(config, **parts)
