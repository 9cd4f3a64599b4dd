"""The returns that came: episodes of the policy as it acts while training, each followed until further rewards do not count."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from dgae_jax.configs.config import CriticConfig, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.envs.base import has_limit
from dgae_jax.learn.build import make_policy, make_quantiles, make_task
from dgae_jax.learn.diagnostics import SIMILAR, similar_means
from dgae_jax.learn.iteration import sampler
from dgae_jax.learn.networks import Network, value_network
from dgae_jax.learn.normalizers import normalize
from dgae_jax.learn.rollout import Episodes, rollout, start
from dgae_jax.learn.types import InferenceState, Params, TrainableState, Transition
from dgae_jax.learn.updates import minibatch_update
from dgae_jax.maths.returns import bellman_target, lambda_sum
from dgae_jax.maths.statistics import coverage, crps, pit
from dgae_jax.maths.transport import quantile_huber_loss, quantile_midpoints
from dgae_jax.run import checkpoint
from dgae_jax.run.checkpoint import Networks
from dgae_jax.run.runtime import Watch, compile_in_thread, unwatched

CHUNK = 100
"""Steps between looks at signals and clock."""

LEFT_OUT = 0.01
"""Weight γᵏ of the first reward that the return from a state leaves out, unless the episode ends before."""

MAX_RETURN_STEPS = 50_000
"""Most steps that a return is followed for."""


class MonteCarlo(NamedTuple):
    """What N worlds showed of a policy in T steps, through which its episodes go on without a time limit."""

    obs: Float[Array, "T N O"]
    reward: Float[Array, "T N"]
    discount: Float[Array, "T N"]
    """γ, and 0 where the episode ended."""
    outcome: Float[Array, "T N"]
    """The discounted return from each state on, of rewards as they are."""


def steps_that_count(gamma: float) -> int:
    """How many rewards of a return have a weight γᵏ above `LEFT_OUT`, at most `LONGEST`."""
    return int(np.count_nonzero(gamma ** np.arange(MAX_RETURN_STEPS) > LEFT_OUT))


def check_returns(config: ResolvedConfig) -> None:
    """Raise ConfigError where returns cannot be followed to their end: γ is too near 1, or the task cuts episodes short itself."""
    if steps_that_count(config.gamma) == MAX_RETURN_STEPS:
        raise invalid(
            "gamma",
            config.gamma,
            f"at most {LEFT_OUT ** (1 / MAX_RETURN_STEPS):.4f}, so that returns can be followed to their end",
        )
    if has_limit(make_task(config)):
        raise invalid(
            "env", config.env, "a task without a time limit of its own, which cuts returns short"
        )


def monte_carlo(
    policy: InferenceState,
    config: ResolvedConfig,
    key: Key[Array, ""],
    worlds: int,
    watch: Watch = unwatched,
) -> MonteCarlo:
    """The outcomes of one policy in as many worlds, over `episode_length` steps, rounded up to whole chunks.

    Actions are drawn from the policy. Raises as `check`.
    """
    check_returns(config)
    env = make_task(config)
    network = make_policy(env, config)

    @jax.jit
    @jax.default_matmul_precision("highest")  # as in training
    def go_on(
        policy: InferenceState, episodes: Episodes, keys: jax.Array
    ) -> tuple[Episodes, Transition]:
        return rollout(env, sampler(network, policy), episodes, keys, episode_length=2**30)

    begin, draw = jax.random.split(key)
    episodes, seen, paid = (
        jax.jit(lambda keys: start(env, keys))(jax.random.split(begin, worlds)),
        [],
        [],
    )
    length = -(-(config.episode_length + steps_that_count(config.gamma)) // CHUNK)
    keys = jax.random.split(draw, (length, CHUNK, worlds))
    compile_in_thread(go_on, policy, episodes, keys[0], watch=watch, what="compiling")
    for i in range(length):
        watch(f"playing step {i * CHUNK:,} of {length * CHUNK:,} in {worlds} worlds")
        episodes, step = go_on(policy, episodes, keys[i])
        seen += [step.obs] if i * CHUNK < config.episode_length else []
        paid.append((step.reward, config.gamma * (1.0 - step.terminated)))
    obs, (reward, discount) = (
        jnp.concatenate(seen),
        (jnp.concatenate(part) for part in zip(*paid, strict=True)),
    )
    return MonteCarlo(
        obs, *(x[: len(obs)] for x in (reward, discount, lambda_sum(reward, discount)))
    )


WORLDS = 64
"""Worlds side by side."""

SHARES = (SIMILAR, 0.03, 0.01, 0.003)
"""Of W₁, up to which |d| counts as that of similar means."""

BINS = 20
"""Of the histogram of the probability integral transform."""


def calibrate(
    source: Path,
    config: ResolvedConfig,
    *,
    which: str,
    index: int = 0,
    seed: int = 0,
    watch: Watch = unwatched,
) -> dict[str, Any]:
    """Statistics of the critic of a run, or in a file, over the `outcomes` of `WORLDS` worlds, actions drawn from the policy.

    Returns are of scaled rewards, as the critic's: `coverage_90` is the share of them inside the central 90 % of the quantiles,
    `crossing` the share of neighbouring quantiles in the wrong order, `bias` and `rmse` those of the mean, `spread` the mean standard
    deviation of the quantiles, `crps` the continuous ranked probability score, `pit` the share of returns in each of `BINS` equal
    parts of probability, `similar_means` the shares of steps whose target and prediction have similar means for their shapes
    (`similar`). Raises as `outcomes.play`, `restore.trained` and `restore.reward_std`.
    """
    found = checkpoint.load_networks(source, config, which)
    policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
    std = float(checkpoint.reward_std(found.path, config)[index])
    came = monte_carlo(policy, config, jax.random.key(seed), WORLDS, watch)
    quantiles = jax.jit(make_quantiles(make_task(config), config))(critic, came.obs)
    about = {"checkpoint": found.path.name, "samples": came.outcome.size}
    similar_means = similar(came.reward / std, came.discount, quantiles)
    return {**about, **statistics(quantiles, came.outcome / std), "similar_means": similar_means}


def statistics(quantiles: jax.Array, outcome: jax.Array) -> dict[str, Any]:
    """Of quantiles [T, N, K] and the returns [T, N] that came."""
    error, probability = (
        np.asarray(quantiles.mean(-1) - outcome),
        np.asarray(pit(quantiles, outcome)),
    )
    falls = jnp.diff(quantiles) < 0
    found = {
        "coverage_90": coverage(quantiles, outcome, 0.9),
        "crossing": falls.mean() if falls.size else 0.0,
        "bias": error.mean(),
        "rmse": np.sqrt((error**2).mean()),
        "spread": quantiles.std(-1).mean(),
        "crps": crps(quantiles, outcome).mean(),
    }
    bins = np.histogram(probability, BINS, (0, 1))[0] / probability.size
    return {
        **{name: round(float(value), 6) for name, value in found.items()},
        "pit": [round(float(share), 6) for share in bins],
    }


def similar(reward: jax.Array, discount: jax.Array, quantiles: jax.Array) -> dict[str, float]:
    """By each of `SHARES`, the share of steps [T − 1, N] with |d(r + γG′, G)| ≤ share · W₁(r + γG′, G) (Sec. results)."""
    before, after = quantiles[:-1], quantiles[1:]
    target = bellman_target(reward[: len(before)], discount[: len(before)], after)
    return {
        str(share): round(float(similar_means(target, before, share).mean()), 6) for share in SHARES
    }


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
    networks: Networks
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
    check_returns(config)
    found = checkpoint.load_networks(source, config, which)
    policy = jax.tree.map(lambda x: x[index], found.policy)
    play_key, fit_key = jax.random.split(
        jax.random.key(seed)
    )  # not the episodes of `calibrate` with the same seed
    came = monte_carlo(policy, config, play_key, worlds, watch)
    spread = came.outcome.std()
    std = jnp.where(spread > 0, spread, 1.0)
    samples = Samples(
        normalize(policy.obs_stats, came.obs).reshape(came.outcome.size, -1),
        (came.outcome / std).ravel(),
    )
    config = _of_one(config, index)
    network = initial_network(samples, config.critic.outputs, config.critic.hidden)
    params = fit_quantiles(network, samples, len(came.outcome), fit_key, watch)
    policy, critic = jax.tree.map(
        lambda x: x[None], (policy, InferenceState(params, policy.obs_stats))
    )
    return Refitted(config, Networks(policy, critic, found.path), std[None], came.outcome.size)


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


def initial_network(samples: Samples, quantiles: int, hidden: Sequence[int]) -> Network:
    """A network that begins near the quantiles of all samples: with γ near 1 they are far from 0 beside their spread."""
    bias = jnp.quantile(samples.outcome, quantile_midpoints(quantiles))
    return value_network(samples.obs.shape[-1], quantiles, hidden=hidden, bias=bias)


def fit_quantiles(
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
        "optimizer": "adam",
        "learning_rate": LEARNING_RATE,
        "learning_rate_end": 0.0,
        "max_grad_norm": 0.5,
    }
    update = minibatch_update(loss, PASSES, epochs=1, minibatches=minibatches, **how)
    begin, *keys = jax.random.split(key, 1 + PASSES)
    params = network.init(begin)
    fit, step = (
        TrainableState(params, update.init(params)),
        jax.jit(jax.default_matmul_precision("highest")(update.step)),
    )
    compile_in_thread(step, keys[0], fit, samples, watch=watch)
    for done, each in enumerate(keys):
        watch(f"fitting, pass {done + 1} of {PASSES}")
        fit, _ = jax.block_until_ready(step(each, fit, samples))
    return fit.params
