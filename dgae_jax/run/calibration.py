"""Calibration of a critic against Monte Carlo returns, and critics that are fitted to them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from dgae_jax.configs.config import CriticConfig, invalid
from dgae_jax.configs.resolved import ResolvedConfig, resolve
from dgae_jax.learn.build import make_quantiles, make_task
from dgae_jax.learn.diagnostics import SIMILAR, similar_means
from dgae_jax.learn.networks import Value, network
from dgae_jax.learn.normalizers import normalize
from dgae_jax.learn.types import InferenceState, Params, TrainableState
from dgae_jax.learn.updates import minibatch_update
from dgae_jax.maths.returns import bellman_target, lambda_sum
from dgae_jax.maths.statistics import coverage, crps, pit
from dgae_jax.maths.transport import quantile_huber_loss, quantile_midpoints
from dgae_jax.run import checkpoint
from dgae_jax.run.checkpoint import Networks
from dgae_jax.run.episodes import SAMPLED_CHUNK, sampled_steps
from dgae_jax.run.runtime import Watch, compile_in_thread, unwatched

NEGLIGIBLE = 0.01
"""Weight γᵏ below which rewards are left out of a return."""

MAX_RETURN_STEPS = 50_000
"""Most steps that a return is followed for."""

NUM_ENVS, BINS = 64, 20
"""Envs side by side in a calibration, and bins of its histogram."""

SHARES = (SIMILAR, 0.03, 0.01, 0.003)
"""Shares of W₁ up to which |d| counts as that of similar means."""

PASSES, LEARNING_RATE = 20, 1e-3
"""Passes of a refit over all returns, and Adam's rate at the start, which decays to zero."""

KAPPA = 1e-4
"""κ of the quantile Huber loss in standard deviations; near 0 its minimizers are quantiles."""


class MonteCarlo(NamedTuple):
    """T steps in N envs without a time limit, and the returns that followed."""

    obs: Float[Array, "T N O"]
    reward: Float[Array, "T N"]
    discount: Float[Array, "T N"]
    """γ, and 0 where the episode ended."""
    returns: Float[Array, "T N"]
    """Discounted sum of the unscaled rewards from each step on."""


def steps_that_count(gamma: float) -> int:
    """Return how many rewards of a return weigh more than `NEGLIGIBLE`."""
    return int(np.count_nonzero(gamma ** np.arange(MAX_RETURN_STEPS) > NEGLIGIBLE))


def return_steps(config: ResolvedConfig) -> int:
    """Return `steps_that_count`, where returns end.

    Raises:
        ConfigError: returns have no end, by γ near 1 or a time limit of the task.
    """
    steps = steps_that_count(config.gamma)
    if steps == MAX_RETURN_STEPS:
        limit = f"at most {NEGLIGIBLE ** (1 / MAX_RETURN_STEPS):.4f}, so that returns end"
        raise invalid("gamma", config.gamma, limit)
    if "truncation" in jax.eval_shape(make_task(config).reset, jax.random.key(0)).info:
        raise invalid("env", config.env, "a task without a time limit of its own")
    return steps


def monte_carlo(
    policy: InferenceState, config: ResolvedConfig, key: Key[Array, ""], num_envs: int, watch: Watch
) -> MonteCarlo:
    """Sample returns of a stochastic policy over `episode_length` steps, in whole chunks.

    Each return is followed until further rewards do not count.
    """
    length = config.episode_length + return_steps(config)
    kept = -(-config.episode_length // SAMPLED_CHUNK)
    seen, paid = [], []
    for step in sampled_steps(policy, config, key, num_envs, length, watch):
        seen += [step.obs] if len(seen) < kept else []
        paid.append((step.reward, config.gamma * (1.0 - step.terminated)))
    obs = jnp.concatenate(seen)
    reward, discount = (jnp.concatenate(part) for part in zip(*paid, strict=True))
    returns = lambda_sum(reward, discount)
    return MonteCarlo(obs, *(x[: len(obs)] for x in (reward, discount, returns)))


def calibrate(
    source: Path,
    config: ResolvedConfig,
    *,
    which: str,
    index: int = 0,
    seed: int = 0,
    watch: Watch = unwatched,
) -> dict[str, Any]:
    """Compute how well a critic's distribution describes Monte Carlo returns.

    Args:
        source: a run directory or a policy file.
        config: its configuration.
        which: latest or best.
        index: the seed among those trained side by side.
        seed: seed of the episodes.
        watch: told the progress.

    Returns:
        `calibration_statistics`, of returns of scaled rewards. `similar_means` are shares of steps
        [T − 1, N] with |d(r + γG′, G)| ≤ share · W₁(r + γG′, G), by share.

    Raises:
        ConfigError: as `return_steps`.
        CheckpointError: as `checkpoint.load_networks` and `checkpoint.reward_std`.
    """
    found = checkpoint.load_networks(source, config, which)
    policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
    std = float(checkpoint.reward_std(found.path, config)[index])
    came = monte_carlo(policy, config, jax.random.key(seed), NUM_ENVS, watch)
    quantiles = jax.jit(make_quantiles(make_task(config), config))(critic, came.obs)
    return {
        "checkpoint": found.path.name,
        "samples": came.returns.size,
        **calibration_statistics(quantiles, came.returns / std),
        "similar_means": similar_mean_shares(came.reward / std, came.discount, quantiles),
    }


def calibration_statistics(quantiles: jax.Array, returns: jax.Array) -> dict[str, Any]:
    """Compare quantiles [T, N, K] with the returns [T, N] that came.

    Returns:
        `coverage_90`, share of returns inside the central 90 %; `crossing`, share of neighbouring
        quantiles in the wrong order; `bias` and `rmse` of the mean; `spread`, mean standard
        deviation of the quantiles; `crps`, continuous ranked probability score; `pit`, histogram
        of the probability integral transform.
    """
    error = np.asarray(quantiles.mean(-1) - returns)
    falls = jnp.diff(quantiles) < 0
    found = {
        "coverage_90": coverage(quantiles, returns, 0.9),
        "crossing": falls.mean() if falls.size else 0.0,
        "bias": error.mean(),
        "rmse": np.sqrt((error**2).mean()),
        "spread": quantiles.std(-1).mean(),
        "crps": crps(quantiles, returns).mean(),
    }
    bins = np.histogram(np.asarray(pit(quantiles, returns)), BINS, (0, 1))[0] / returns.size
    numbers = {name: round(float(value), 6) for name, value in found.items()}
    return {**numbers, "pit": [round(float(share), 6) for share in bins]}


def similar_mean_shares(
    reward: jax.Array, discount: jax.Array, quantiles: jax.Array
) -> dict[str, float]:
    """Return the share of steps with similar means before and after, by share of W₁."""
    before, after = quantiles[:-1], quantiles[1:]
    target = bellman_target(reward[:-1], discount[:-1], after)
    similar = {share: similar_means(target, before, share).mean() for share in SHARES}
    return {str(share): round(float(mean), 6) for share, mean in similar.items()}


def refit(
    source: Path,
    config: ResolvedConfig,
    *,
    which: str,
    index: int = 0,
    seed: int = 0,
    num_envs: int = 128,
    watch: Watch = unwatched,
) -> tuple[ResolvedConfig, Networks, Float[Array, "1"]]:
    """Fit a `sorted` critic to Monte Carlo returns of a policy that is held fixed.

    Quantile regression (Koenker & Bassett 1978) without bootstrapping. Returns are scaled by
    their standard deviation. Arguments and errors as `calibrate`.

    Returns:
        The arguments of `checkpoint.save_networks`.
    """
    found = checkpoint.load_networks(source, config, which)
    policy = jax.tree.map(lambda x: x[index], found.policy)
    play_key, fit_key = jax.random.split(jax.random.key(seed))  # not the episodes of `calibrate`
    came = monte_carlo(policy, config, play_key, num_envs, watch)
    spread = came.returns.std()
    std = jnp.where(spread > 0, spread, 1.0)
    obs = normalize(policy.obs_stats, came.obs).reshape(came.returns.size, -1)
    samples = obs, (came.returns / std).ravel()
    written = config.as_config()
    kept = {name: getattr(written.critic, name) for name in ("quantiles", "target")}
    critic = CriticConfig(kind="sorted", hidden=config.critic.hidden, **kept)
    one = {"seed": config.seed + index, "num_seeds": 1}
    config = resolve(written.replace(**one, normalize_rewards=True, critic=critic))
    layers = config.critic.outputs, config.critic.hidden
    params = fit_quantiles(samples, *layers, len(came.returns), fit_key, watch)
    states = policy, InferenceState(params, policy.obs_stats)
    policy, critic = jax.tree.map(lambda x: x[None], states)
    return config, Networks(policy, critic, found.path), std[None]


def fit_quantiles(
    samples: tuple[Float[Array, "B O"], Float[Array, " B"]],
    outputs: int,
    hidden: Sequence[int],
    minibatches: int,
    key: Key[Array, ""],
    watch: Watch = unwatched,
) -> Params:
    """Fit the outputs of a value network to quantiles of the returns, in `PASSES` over them.

    The outputs are not sorted during the fit: as good, in half the time. `samples` are normalized
    observations and scaled returns, `minibatches` the number of gradient steps per pass.
    """
    obs, returns = samples
    bias = jnp.quantile(returns, quantile_midpoints(outputs))  # returns may be far from 0
    values = network(Value(hidden, outputs, bias=bias), obs.shape[-1])

    def loss(params: Params, batch: Any):
        obs, returns = batch
        quantiles = values.apply(params, obs)
        value = quantile_huber_loss(quantiles, returns[:, None], kappa=KAPPA) / KAPPA
        return value.mean(), {}

    rates = {"learning_rate": LEARNING_RATE, "learning_rate_end": 0.0, "max_grad_norm": 0.5}
    how: dict[str, Any] = {"optimizer": "adam", **rates, "epochs": 1, "minibatches": minibatches}
    update = minibatch_update(loss, PASSES, **how)
    begin, *keys = jax.random.split(key, 1 + PASSES)
    params = values.init(begin)
    state = TrainableState(params, update.init(params))
    step = jax.jit(jax.default_matmul_precision("highest")(update.step))
    compile_in_thread(step, keys[0], state, samples, watch=watch)
    for done, each in enumerate(keys):
        watch(f"fitting, pass {done + 1} of {PASSES}")
        state, _ = jax.block_until_ready(step(each, state, samples))
    return state.params
