"""Train on 1, 2 and 4 devices, in a process whose CPU poses as four: python -m tests.learn.shared_run FILE"""

import dataclasses
import sys

import jax
import numpy as np

import dgae_jax as dg
from dgae_jax.learn import devices
from dgae_jax.learn.build import make_trainer, seed_keys
from tests.helpers import small

ITERATIONS = 10


def trained(algo, count, seeds=1, iterations=ITERATIONS):
    """The numbers of both networks after so many iterations, and the metrics."""
    config = dataclasses.replace(small(algo), num_envs=8, num_steps=16, num_seeds=seeds)
    trainer = make_trainer(
        dg.make_env("hopper", physics="native"), ITERATIONS, devices.make_mesh(count)
    )
    state, rows = trainer.dispatch(config, trainer.init(config, seed_keys(config)), iterations)
    assert len(state.episodes.total.sharding.device_set) == count
    return np.concatenate(
        [x.ravel() for x in jax.tree.leaves((state.policy.params, state.critic.params))]
    ), rows


def main(path):
    """Write everything to one file."""
    devices.divide_cpu(4)
    found = {}
    for name in ("dppo", "dtrpo"):
        found[f"{name} start"], _ = trained(name, 1, iterations=0)
        for count in (1, 2, 4):
            found[f"{name} {count}"], rows = trained(name, count)
            found[f"{name} {count} reward"] = rows["reward"]
    for seeds, count in ((4, 1), (4, 4), (3, 1), (3, 4)):
        found[f"{seeds} seeds {count}"], _ = trained("dppo", count, seeds)
    devices._apart = lambda mesh: False  # as on accelerators
    for name in ("dppo", "dtrpo"):
        found[f"{name} gradients"], _ = trained(name, 4)
    np.savez(path, **found)


if __name__ == "__main__":
    main(sys.argv[1])
