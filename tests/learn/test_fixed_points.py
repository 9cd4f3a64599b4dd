"""Where each critic target leads, on a process whose return distribution is known.

From `first` a fair coin pays ±1 and leads to `second`, where another pays ±1 and leads to the end. With γ = ½ the return
from `first` is ±1 ± ½, each with probability ¼, and from `second` ±1.
"""

import jax
import jax.numpy as jnp
import optax
import pytest
from numpy.testing import assert_allclose

from dgae_jax.configs.parts import CRITICS, TARGETS
from dgae_jax.learn.types import Batch
from dgae_jax.maths.returns import decay

FIRST, SECOND, END = jnp.eye(3)
TRUE = {"first": [-1.5, -0.5, 0.5, 1.5], "second": [-1, -1, 1, 1]}


def episodes(end):
    """The four equally likely episodes, 64 times each: three steps of (obs, reward, terminated, next_obs)."""
    coins = jnp.tile(jnp.array([[-1.0, -1], [-1, 1], [1, -1], [1, 1]]), (64, 1))
    count = len(coins)
    reward = jnp.stack([coins[:, 0], coins[:, 1], jnp.zeros(count)])
    obs = jnp.broadcast_to(jnp.stack([FIRST, SECOND, END])[:, None], (3, count, 3))
    next_obs = jnp.broadcast_to(jnp.stack([SECOND, END, END])[:, None], (3, count, 3))
    terminated = jnp.broadcast_to(jnp.array([False, end == "terminal", False])[:, None], (3, count))
    return obs, reward, terminated, next_obs


def fixed_point(kind, target, lam, end="terminal"):
    """The quantiles of a table (a linear network on one-hot observations) after fitting one target for long."""
    options = {} if kind == "scalar" else {"quantiles": 4, "kappa": 1e-2}
    critic = CRITICS[kind].build(3, hidden=(), target=TARGETS[target].build, **options)
    obs, reward, terminated, next_obs = episodes(end)
    lam = lam if critic.lam is None else critic.lam
    discount, trace = decay(
        terminated, jnp.zeros_like(terminated).at[-1].set(True), gamma=0.5, lam=lam
    )
    steps = 1500
    optimizer = optax.adam(optax.cosine_decay_schedule(0.05, steps))

    def iteration(carry, key):
        params, opt_state = carry
        z, z_next = (critic.predict(params, x) for x in (obs, next_obs))
        fitted_to = critic.target(key, reward, discount, trace, z, z_next)
        batch = Batch(
            obs,
            obs,
            reward,
            reward,
            z.mean(-1),
            fitted_to,
            reward,
            discount,
            next_obs,
            jnp.ones_like(terminated),
        )
        batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
        gradient = jax.grad(lambda p: critic.loss(p, batch)[0])(params)
        updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(params, updates), opt_state), None

    params = critic.init(jax.random.key(0))
    (params, _), _ = jax.jit(
        lambda c: jax.lax.scan(iteration, c, jax.random.split(jax.random.key(1), steps))
    )((params, optimizer.init(params)))
    return {
        name: jnp.sort(critic.predict(params, x))
        for name, x in (("first", FIRST), ("second", SECOND), ("end", END))
    }


@pytest.mark.parametrize("kind", ["quantile", "ordered"])
@pytest.mark.parametrize("end", ["terminal", "absorbing"])
@pytest.mark.parametrize(
    ("target", "lam"),
    [
        ("bellman", 0.5),
        ("bellman-frozen", 0.5),
        ("sr-lambda", 0.5),
        ("sr-lambda", 1.0),
        ("lambda-shift", 0.0),
        ("lambda-return", 1.0),
        ("monte-carlo", 0.0),
    ],
)
def test_the_critic_learns_the_true_quantiles(kind, target, lam, end):
    got = fixed_point(kind, target, lam, end)
    assert_allclose(got["first"], TRUE["first"], atol=0.1)
    assert_allclose(got["second"], TRUE["second"], atol=0.1)


def test_the_scalar_return_with_a_bootstrap_loses_the_spread_of_what_it_bootstraps():
    # λ = 0: all quantiles see r + γ E[G(second)] = ±1
    assert_allclose(
        fixed_point("quantile", "lambda-return", 0.0)["first"], [-1, -1, 1, 1], atol=0.1
    )


def test_the_shifted_target_counts_the_spread_of_the_bootstrap_twice():
    # λ = 1: the mean moves with the second coin and the shape holds it again: ±1 ± ½ ± ½
    got = fixed_point("quantile", "lambda-shift", 1.0)["first"]
    assert got.std() > 1.05 * jnp.array(TRUE["first"]).std()


@pytest.mark.parametrize("target", sorted(TARGETS))
def test_a_scalar_critic_learns_the_mean_from_every_target(target):
    got = fixed_point("scalar", target, 0.5)
    assert_allclose(got["first"], [0], atol=0.05)
    assert_allclose(got["second"], [0], atol=0.05)
