"""Configurations as pytrees: the floats and the sample budget are leaves, everything else is static.

Leaves may be traced, so that a sweep over them is one compiled program, and changing one does not compile again.
"""

import dataclasses

import jax

from dgae_jax.configs.config import Config, CriticConfig, PolicyConfig, floats_of


def _register(cls: type, *more: str) -> None:
    floats = floats_of(cls)
    static = [f.name for f in dataclasses.fields(cls) if f.name not in (*floats, *more)]
    jax.tree_util.register_dataclass(cls, data_fields=[*floats, *more], meta_fields=static)


_register(PolicyConfig)
_register(CriticConfig)
_register(Config, "total_steps", "policy", "critic")
