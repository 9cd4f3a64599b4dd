"""A value distribution for a policy that is held fixed, fitted to the returns that came (quantile regression, Koenker & Bassett 1978).

Nothing is bootstrapped and no policy depends on it, so what it holds of the returns is a matter of the regression alone.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from dgae_jax.configs.config import CriticConfig
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.learn.networks import Network, value_network
from dgae_jax.learn.normalizers import normalize
from dgae_jax.learn.types import InferenceState, Params, TrainableState
from dgae_jax.learn.updates import adam, descend
from dgae_jax.maths.transport import quantile_huber_loss, quantile_midpoints
from dgae_jax.run import outcomes, restore
from dgae_jax.run.compiling import Watch, compile_aside, unwatched
from dgae_jax.run.restore import Trained

PASSES, LEARNING_RATE = 20, 1e-3
"""Over all returns, and Adam's rate at the start, which falls to zero."""

KAPPA = 1e-4
"""Of the quantile-Huber loss, in standard deviations of the returns: near 0 its minimisers are quantiles."""


class Samples(NamedTuple):
    """What a distribution is fitted to."""

    obs: Float[Array, "B O"]
    """Normalised."""
    outcome: Float[Array, " B"]
    """Scaled."""


class Refitted(NamedTuple):
    """A policy as it was with a critic that was fitted to it, as `restore.save_networks` takes them."""

    config: ResolvedConfig
    networks: Trained
    std: Float[Array, "1"]
    """What rewards are divided by."""
    returns: int
    """How many it was fitted to."""


def refit(
    source: Path,
    config: ResolvedConfig,
    *,
    which: str,
    index: int = 0,
    seed: int = 0,
    worlds: int = 128,
    watch: Watch = unwatched,
) -> Refitted:
    """The policy of a run, or of a file, with a `sorted` critic whose outputs were fitted to its `outcomes` in so many worlds.

    Returns are scaled by their standard deviation. Raises as `outcomes.play` and `restore.trained`.
    """
    outcomes.check(config)
    found = restore.trained(source, config, which)
    policy = jax.tree.map(lambda x: x[index], found.policy)
    play_key, fit_key = jax.random.split(
        jax.random.key(seed)
    )  # not the episodes of `calibrate` with the same seed
    came = outcomes.play(policy, config, play_key, worlds, watch)
    spread = came.outcome.std()
    std = jnp.where(spread > 0, spread, 1.0)
    samples = Samples(
        normalize(policy.obs_stats, came.obs).reshape(came.outcome.size, -1),
        (came.outcome / std).ravel(),
    )
    config = _of_one(config, index)
    network = begun(samples, config.critic.outputs, config.critic.hidden)
    params = fitted(network, samples, len(came.outcome), fit_key, watch)
    policy, critic = jax.tree.map(
        lambda x: x[None], (policy, InferenceState(params, policy.obs_stats))
    )
    return Refitted(config, Trained(policy, critic, found.path), std[None], came.outcome.size)


def _of_one(config: ResolvedConfig, index: int) -> ResolvedConfig:
    """The configuration of the run with that index alone, and of a `sorted` critic of rewards that are scaled."""
    written = config.as_config()
    critic = CriticConfig(
        kind="sorted",
        hidden=config.critic.hidden,
        quantiles=written.critic.quantiles,
        target=written.critic.target,
    )
    one = {"seed": config.seed + index, "num_seeds": 1}
    return resolve(written.replace(**one, normalize_rewards=True, critic=critic))


def begun(samples: Samples, quantiles: int, hidden: Sequence[int]) -> Network:
    """A network that begins near the quantiles of all samples: with γ near 1 they are far from 0 beside their spread."""
    bias = jnp.quantile(samples.outcome, quantile_midpoints(quantiles))
    return value_network(samples.obs.shape[-1], quantiles, hidden=hidden, bias=bias)


def fitted(
    network: Network,
    samples: Samples,
    minibatches: int,
    key: Key[Array, ""],
    watch: Watch = unwatched,
) -> Params:
    """The parameters with which the network's outputs are quantiles of the samples, after `PASSES` over them.

    A pass takes `minibatches` gradient steps. The outputs are fitted as they are and not sorted, which is as good and takes about half
    of the time.
    """

    def loss(params: Params, samples: Samples):
        quantiles = network.apply(params, samples.obs)
        return (
            quantile_huber_loss(quantiles, samples.outcome[:, None], kappa=KAPPA) / KAPPA
        ).mean(), {}

    how = {
        "optimizer": adam,
        "learning_rate": LEARNING_RATE,
        "learning_rate_end": 0.0,
        "max_grad_norm": 0.5,
    }
    update = descend(loss, PASSES, epochs=1, minibatches=minibatches, **how)
    begin, *keys = jax.random.split(key, 1 + PASSES)
    params = network.init(begin)
    fit, step = (
        TrainableState(params, update.init(params)),
        jax.jit(jax.default_matmul_precision("highest")(update.step)),
    )
    compile_aside(step, keys[0], fit, samples, watch=watch)
    for done, each in enumerate(keys):
        watch(f"fitting, pass {done + 1} of {PASSES}")
        fit, _ = jax.block_until_ready(step(each, fit, samples))
    return fit.params
