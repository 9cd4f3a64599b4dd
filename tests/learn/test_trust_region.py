"""TRPO's step against definitions, dense matrices, and an implementation in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

from dgae_jax.learn.networks import SharedCovariance, gaussian_policy
from dgae_jax.learn.types import TrainableState
from dgae_jax.learn.updates import fisher_product, surrogate, trpo_update, trust_region
from dgae_jax.maths import gaussian
from tests.helpers import distance
from tests.learn.batches import make_batch

POLICY = gaussian_policy(3, 2, hidden=(5,), covariance=SharedCovariance, initial_std=0.7)
SEARCH = {"damping": 0.1, "cg_iterations": 30, "max_backtracks": 10, "fisher_every": 1}


def example(seed=0, count=100):
    key = jax.random.key(seed)
    params = POLICY.init(key)
    params = jax.tree.map(lambda x: x + 0.3 * jax.random.normal(key, x.shape), params)
    obs = jax.random.normal(key, (count, 3))
    here = POLICY.apply(params, obs)
    action = gaussian.sample(key, here)
    advantage = jnp.sin(action[:, 0] + obs[:, 1]) - 0.5 * action[:, 1] ** 2
    advantage = (advantage - advantage.mean()) / advantage.std()
    log_prob = gaussian.log_prob(here, action)
    return params, make_batch(obs, action=action, log_prob=log_prob, advantage=advantage)


def step(params, batch, loss=None, max_kl=0.01, **changes):
    """The parameters after one step, and its info."""
    options = SEARCH | changes
    update = trust_region(POLICY, loss or surrogate(POLICY), max_kl=lambda count: max_kl, **options)
    state = TrainableState(params, update.init(params))
    state, info = jax.jit(update.step)(jax.random.key(0), state, batch)
    return state.params, info


def mean_kl(old, new, batch):
    return float(gaussian.kl(POLICY.apply(old, batch.obs), POLICY.apply(new, batch.obs)).mean())


def moved(new, old):
    """The step as a float64 vector."""
    new, old = (np.asarray(ravel_pytree(x)[0], np.float64) for x in (new, old))
    return new - old


def test_fisher_product_is_the_hessian_of_the_mean_kl():
    params, batch = example()
    flat, unravel = ravel_pytree(params)
    here = POLICY.apply(params, batch.obs)

    def kl(x):
        return gaussian.kl(here, POLICY.apply(unravel(x), batch.obs)).mean()

    product = fisher_product(POLICY, params, batch.obs, 0.0)
    columns = jax.jit(jax.vmap(lambda v: ravel_pytree(product(unravel(v)))[0]))(jnp.eye(len(flat)))
    assert_allclose(columns, jax.jit(jax.hessian(kl))(flat), atol=1e-5)
    damped = fisher_product(POLICY, params, batch.obs, 0.5)(params)
    want = jax.tree.map(lambda f, p: f + 0.5 * p, product(params), params)
    assert distance(want, damped) < 1e-6


@pytest.mark.parametrize("max_kl", [1e-3, 1e-2, 0.1])
def test_an_accepted_step_stays_within_max_kl_and_improves(max_kl):
    params, batch = example()
    new, info = step(params, batch, max_kl=max_kl)
    assert info["accepted"] == 1
    assert 0.1 * max_kl < mean_kl(params, new, batch) <= max_kl
    loss = surrogate(POLICY)
    assert_allclose(loss(params, batch)[0] - loss(new, batch)[0], info["improvement"], atol=1e-6)
    assert info["improvement"] > 0


@pytest.mark.parametrize("case", ["no better point", "no gradient"])
def test_a_failed_search_leaves_the_parameters_bit_for_bit(case):
    params, batch = example()
    start = ravel_pytree(params)[0]

    def nowhere_better(p, batch):
        value, info = surrogate(POLICY)(p, batch)
        worse = jnp.where((ravel_pytree(p)[0] == start).all(), 0, 10)
        return value + jax.lax.stop_gradient(worse), info

    loss = nowhere_better if case == "no better point" else surrogate(POLICY)
    if case == "no gradient":
        batch = batch._replace(advantage=jnp.zeros_like(batch.advantage))
    new, info = step(params, batch, loss)
    assert info["accepted"] == info["kl"] == 0
    for a, b in zip(jax.tree.leaves(params), jax.tree.leaves(new), strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_step_that_is_too_long_is_halved():
    # the Fisher matrix is estimated from every second sample, and the others are 30 times larger
    params, batch = example()
    batch = batch._replace(obs=batch.obs.at[1::2].multiply(30))
    new, info = step(params, batch, max_kl=1.0, fisher_every=2)
    assert info["halvings"] >= 1
    assert mean_kl(params, new, batch) <= 1.0


def independent_step(params, batch, max_kl, damping):
    """Return the natural gradient step in float64: central differences and dense matrices."""
    flat, unravel = ravel_pytree(params)
    flat, obs, action, advantage = (
        np.asarray(x, np.float64) for x in (flat, batch.obs, batch.action, batch.advantage)
    )
    layout = unravel(jnp.arange(len(flat), dtype=jnp.float32))["params"]
    at = {name: np.asarray(leaf).astype(int) for name, leaf in (("s", layout["log_std"]),)}
    hidden, out = layout["Torso_0"]["Dense_0"], layout["Dense_0"]
    at |= {
        f"{n}{k[0]}": np.asarray(layer[k]).astype(int)
        for n, layer in (("h", hidden), ("o", out))
        for k in ("kernel", "bias")
    }

    def mean(x):
        return np.tanh(obs @ x[at["hk"]] + x[at["hb"]]) @ x[at["ok"]] + x[at["ob"]]

    eye, step = np.eye(len(flat)), 1e-6
    jacobian = np.stack(
        [(mean(flat + step * e) - mean(flat - step * e)) / (2 * step) for e in eye], -1
    )  # [B, A, P]
    std = np.exp(flat[at["s"]])
    standard = (action - mean(flat)) / std
    score = np.einsum("ba,bap->bp", standard / std, jacobian)
    score[:, at["s"]] += standard**2 - 1
    gradient = (advantage[:, None] * score).mean(0)
    scaled = jacobian / std[:, None]
    fisher = np.einsum("bap,baq->pq", scaled, scaled) / len(obs)
    fisher[at["s"], at["s"]] += 2
    direction = scipy.linalg.solve(fisher + damping * eye, gradient, assume_a="pos")
    return direction * np.sqrt(2 * max_kl / (direction @ (fisher + damping * eye) @ direction))


@pytest.mark.parametrize("seed", range(2))
def test_the_step_is_that_of_an_independent_implementation(seed):
    params, batch = example(seed)
    new, info = step(params, batch, max_kl=1e-4, cg_iterations=60)
    assert (info["accepted"], info["halvings"]) == (1, 0)
    ours, theirs = moved(new, params), independent_step(params, batch, 1e-4, 0.1)
    assert ours @ theirs / np.linalg.norm(ours) / np.linalg.norm(theirs) > 0.999
    assert_allclose(np.linalg.norm(ours), np.linalg.norm(theirs), rtol=0.01)


def test_max_kl_decays_in_the_last_fifth_of_a_run():
    params, batch = example()
    update = trpo_update(POLICY, 20, max_kl=0.01, learning_rate_end=0.0, **SEARCH)
    state, kls = TrainableState(params, update.init(params)), []
    jitted = jax.jit(update.step)
    for _ in range(20):  # always from the same policy
        state, info = jitted(jax.random.key(0), state._replace(params=params), batch)
        kls.append(float(info["kl"]))
    assert int(state.opt_state) == 20
    # the divergence of a step that is not halved is max_kl up to third order
    assert_allclose(np.array(kls) / kls[0], [1] * 17 + [3 / 4, 2 / 4, 1 / 4], rtol=0.05)
