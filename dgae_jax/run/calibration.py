"""How well a critic's distribution describes the returns that came, of the policy that acts as it did while training."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dgae_jax.configs.build import make_algorithm, make_task
from dgae_jax.configs.config import Config, invalid
from dgae_jax.learn import normalizers
from dgae_jax.learn.diagnostics import SIMILAR, similar_means
from dgae_jax.learn.iteration import acting
from dgae_jax.learn.rollout import Episodes, rollout, start
from dgae_jax.learn.types import Fitted, Transition
from dgae_jax.maths.returns import bellman_target, lambda_sum
from dgae_jax.maths.statistics import coverage, crps, pit
from dgae_jax.run import restore
from dgae_jax.run.compiling import Watch, compile_aside, unwatched

WORLDS, CHUNK = 64, 100
"""Worlds side by side, and steps between looks at signals and clock."""

LEFT_OUT = 0.01
"""Weight γᵏ of the first reward that the return from a state leaves out, unless the episode ends before."""

LONGEST = 50_000
"""Most steps that a return is followed for."""

SHARES = (SIMILAR, 0.03, 0.01, 0.003)
"""Of W₁, up to which |d| counts as that of similar means."""

BINS = 20
"""Of the histogram of the probability integral transform."""


def steps_that_count(gamma: float) -> int:
    """How many rewards of a return have a weight γᵏ above `LEFT_OUT`, at most `LONGEST`."""
    return int(np.count_nonzero(gamma ** np.arange(LONGEST) > LEFT_OUT))


def calibrate(run_dir: Path, config: Config, *, which: str, index: int = 0, seed: int = 0, watch: Watch = unwatched) -> dict[str, Any]:
    """Statistics of a run's critic over `episode_length` steps in each of `WORLDS` worlds, actions drawn from the policy.

    Returns are of scaled rewards, as the critic's, followed until γᵏ < `LEFT_OUT` without a time limit: `coverage_90` is the share
    of them inside the central 90 % of the quantiles, `crossing` the share of neighbouring quantiles in the wrong order, `bias` and
    `rmse` those of the mean, `spread` the mean standard deviation of the quantiles, `crps` the continuous ranked probability score,
    `pit` the share of returns in each of `BINS` equal parts of probability, `similar_means` the shares of steps whose target and
    prediction have similar means for their shapes (`similar`). Raises ConfigError where γ is too near 1 for returns to
    be followed, and as `restore.trained`.
    """
    if (tail := steps_that_count(config.gamma)) == LONGEST:
        raise invalid("gamma", config.gamma, f"at most {LEFT_OUT ** (1 / LONGEST):.4f}, so that returns can be followed to their end")
    found = restore.trained(run_dir, config, which)
    policy, critic = jax.tree.map(lambda x: x[index], (found.policy, found.critic))
    std = float(restore.reward_std(found.path, config)[index])
    env = make_task(config)
    algorithm = make_algorithm(str(config.algo), env, config)

    @jax.jit
    @jax.default_matmul_precision("highest")  # as in training
    def go_on(policy: Fitted, critic: Fitted, worlds: Episodes, keys: jax.Array) -> tuple[Episodes, Transition, jax.Array]:
        worlds, step = rollout(env, acting(algorithm, policy), worlds, keys, episode_length=2**30)
        return worlds, step, algorithm.critic.predict(critic.params, normalizers.normalize(critic.observations, step.obs))

    begin, draw = jax.random.split(jax.random.key(seed))
    worlds, parts = jax.jit(lambda keys: start(env, keys))(jax.random.split(begin, WORLDS)), []
    length = -(-(config.episode_length + tail) // CHUNK)
    keys = jax.random.split(draw, (length, CHUNK, WORLDS))
    compile_aside(go_on, policy, critic, worlds, keys[0], watch=watch, what="compiling")
    for i in range(length):
        watch(f"playing step {i * CHUNK:,} of {length * CHUNK:,} in {WORLDS} worlds")
        worlds, step, quantiles = go_on(policy, critic, worlds, keys[i])
        kept = i * CHUNK < config.episode_length
        parts.append((step.reward / std, config.gamma * (1.0 - step.terminated), quantiles if kept else None))
    rewards, discounts, predicted = zip(*parts, strict=True)
    quantiles = jnp.concatenate([each for each in predicted if each is not None])
    reward, discount = jnp.concatenate(rewards), jnp.concatenate(discounts)
    outcome = lambda_sum(reward, discount)[: len(quantiles)]
    about = {"checkpoint": found.path.name, "samples": outcome.size}
    return {**about, **statistics(quantiles, outcome), "similar_means": similar(reward, discount, quantiles)}


def statistics(quantiles: jax.Array, outcome: jax.Array) -> dict[str, Any]:
    """Of quantiles [T, N, K] and the returns [T, N] that came."""
    error, probability = np.asarray(quantiles.mean(-1) - outcome), np.asarray(pit(quantiles, outcome))
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
    return {**{name: round(float(value), 6) for name, value in found.items()}, "pit": [round(float(share), 6) for share in bins]}


def similar(reward: jax.Array, discount: jax.Array, quantiles: jax.Array) -> dict[str, float]:
    """By each of `SHARES`, the share of steps [T − 1, N] with |d(r + γG′, G)| ≤ share · W₁(r + γG′, G) (Sec. results)."""
    before, after = quantiles[:-1], quantiles[1:]
    target = bellman_target(reward[: len(before)], discount[: len(before)], after)
    return {str(share): round(float(similar_means(target, before, share).mean()), 6) for share in SHARES}
