"""Critics: their losses and targets, where each target leads, and their calibration.

The fixed points are those of a process with a known return distribution. From `FIRST` a fair coin
pays ±1 and leads to `SECOND`, where another pays ±1 and leads to the end. With γ = ½ the return
from `FIRST` is ±1 ± ½, each with probability ¼, and from `SECOND` ±1.
"""

import jax
import jax.numpy as jnp
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dgae_jax.learn.critics import CRITICS, TARGETS
from dgae_jax.learn.diagnostics import critic_diagnostics
from dgae_jax.maths.returns import decay
from tests.learn.batches import make_batch

FIRST, SECOND, END = jnp.eye(3)
TRUE = {"first": [-1.5, -0.5, 0.5, 1.5], "second": [-1, -1, 1, 1]}


def make_critic(kind, target, hidden=(8,), quantiles=4, kappa=1.0):
    options = {} if kind == "scalar" else {"quantiles": quantiles, "kappa": kappa}
    return CRITICS[kind](3, hidden=hidden, target=TARGETS[target], **options)


def episodes(end):
    """The four equally likely episodes, 64 times each; three steps, the last in an idle state."""
    coins = jnp.tile(jnp.array([[-1.0, -1], [-1, 1], [1, -1], [1, 1]]), (64, 1))
    count = len(coins)
    reward = jnp.stack([coins[:, 0], coins[:, 1], jnp.zeros(count)])
    obs = jnp.broadcast_to(jnp.stack([FIRST, SECOND, END])[:, None], (3, count, 3))
    next_obs = jnp.broadcast_to(jnp.stack([SECOND, END, END])[:, None], (3, count, 3))
    terminated = jnp.broadcast_to(jnp.array([False, end == "terminal", False])[:, None], (3, count))
    return obs, reward, terminated, next_obs


def fixed_point(kind, target, lam, end="terminal", steps=1500):
    """Quantiles of a table (a linear network on one-hot observations) after a long fit."""
    critic = make_critic(kind, target, hidden=(), kappa=1e-2)
    obs, reward, terminated, next_obs = episodes(end)
    truncated = jnp.zeros_like(terminated).at[-1].set(True)
    lam = lam if critic.lam is None else critic.lam
    discount, trace = decay(terminated, truncated, gamma=0.5, lam=lam)
    optimizer = optax.adam(optax.cosine_decay_schedule(0.05, steps))

    def iteration(carry, key):
        params, opt_state = carry
        quantiles, next_quantiles = (critic.predict(params, x) for x in (obs, next_obs))
        given = {"reward": reward, "discount": discount, "next_obs": next_obs}
        target = critic.target(key, reward, discount, trace, quantiles, next_quantiles)
        batch = make_batch(obs, value=quantiles.mean(-1), target=target, **given)
        batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
        gradient = jax.grad(lambda p: critic.loss(p, batch)[0])(params)
        updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(params, updates), opt_state), None

    @jax.jit
    def fit(params):
        keys = jax.random.split(jax.random.key(1), steps)
        return jax.lax.scan(iteration, (params, optimizer.init(params)), keys)[0][0]

    params = fit(critic.init(jax.random.key(0)))
    states = {"first": FIRST, "second": SECOND, "end": END}
    return {name: jnp.sort(critic.predict(params, obs)) for name, obs in states.items()}


@pytest.mark.parametrize(
    ("kind", "target", "lam", "end"),
    [
        ("quantile", "bellman", 0.5, "terminal"),
        ("quantile", "bellman-frozen", 0.5, "terminal"),
        ("quantile", "sr-lambda", 0.5, "terminal"),
        ("quantile", "lambda-shift", 0.0, "terminal"),
        ("quantile", "lambda-return", 1.0, "terminal"),
        ("quantile", "monte-carlo", 0.0, "terminal"),
        ("ordered", "bellman", 0.5, "terminal"),
        ("ordered", "sr-lambda", 0.5, "terminal"),
        ("quantile", "sr-lambda", 0.5, "absorbing"),
    ],
)
def test_the_critic_learns_the_true_quantiles(kind, target, lam, end):
    got = fixed_point(kind, target, lam, end)
    assert_allclose(got["first"], TRUE["first"], atol=0.1)
    assert_allclose(got["second"], TRUE["second"], atol=0.1)


def test_other_targets_have_spreads_of_their_own():
    # λ = 0: all quantiles see r + γ E[G(second)] = ±1; λ = 1: the mean moves with the second coin
    # and the shape holds it again, ±1 ± ½ ± ½
    assert_allclose(
        fixed_point("quantile", "lambda-return", 0.0)["first"], [-1, -1, 1, 1], atol=0.1
    )
    twice = fixed_point("quantile", "lambda-shift", 1.0)["first"]
    assert twice.std() > 1.05 * jnp.array(TRUE["first"]).std()


@pytest.mark.parametrize("target", ["bellman", "sr-lambda", "lambda-return"])
def test_a_scalar_critic_learns_the_mean_from_its_targets(target):
    got = fixed_point("scalar", target, 0.5, steps=500)
    assert_allclose([got["first"], got["second"]], 0, atol=0.05)


# ---- losses ----


@pytest.fixture(scope="module")
def batch():
    obs, next_obs = jax.random.normal(jax.random.key(0), (2, 24, 3))
    reward = jax.random.normal(jax.random.key(1), (24,))
    discount = jnp.full(24, 0.9)
    return make_batch(
        obs, target=reward[:, None], reward=reward, discount=discount, next_obs=next_obs
    )


@pytest.mark.parametrize(("target", "follows"), [("bellman", True), ("bellman-frozen", False)])
def test_only_the_bellman_target_follows_the_critic(target, follows, batch, key):
    critic = make_critic("quantile", target)
    params = critic.init(key)
    elsewhere = batch._replace(next_obs=batch.next_obs + 1)
    changed = critic.loss(params, batch)[0] != critic.loss(params, elsewhere)[0]
    assert changed == follows


def test_a_sorted_critic_is_a_quantile_critic_with_sorted_predictions(batch, key):
    plain, ordered = (make_critic(kind, "bellman", quantiles=8) for kind in ("quantile", "sorted"))
    params = plain.init(key)
    predicted = plain.predict(params, batch.obs)
    assert (jnp.diff(predicted) < 0).any()
    assert_array_equal(ordered.predict(params, batch.obs), jnp.sort(predicted))
    assert ordered.loss(params, batch)[0] == plain.loss(params, batch)[0]


# ---- calibration ----


def test_similar_means_and_crossing_quantiles_are_counted():
    # d = 0 against W₁ = 2, d = W₁ = 2, d = 0.5 against W₁ = 2
    narrow, wide, shifted = jnp.array([-1.0, 1.0]), jnp.array([-3.0, 3.0]), jnp.array([1.0, 3.0])
    quantiles = jnp.stack([narrow] * 3)[:, None]
    next_quantiles = jnp.stack([wide, shifted, wide + 0.5])[:, None]
    one, zero = jnp.ones((3, 1)), jnp.zeros((3, 1))
    got = critic_diagnostics(zero, one, zero, quantiles, next_quantiles)
    assert_allclose(got["critic/similar_means"], 1 / 3)
    crossing = critic_diagnostics(zero, one, zero, quantiles.at[0].multiply(-1), next_quantiles)
    assert_allclose([got["critic/crossing"], crossing["critic/crossing"]], [0, 1 / 3])
