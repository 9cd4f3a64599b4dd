"""TRPO's step against definitions, dense matrices, and an implementation in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

from dgae_jax.learn import updates
from dgae_jax.learn.networks import SharedCovariance, network
from dgae_jax.learn.types import TrainableState
from dgae_jax.learn.updates import surrogate, trpo_update
from dgae_jax.maths import gaussian
from tests.learn.batches import make_batch

POLICY = network(SharedCovariance((5,), 2, 0.7), 3)
SETTINGS = {
    "max_kl": 0.01,
    "learning_rate_end": 1.0,
    "damping": 0.1,
    "cg_iterations": 30,
    "max_backtracks": 10,
    "fisher_every": 1,
}


def example():
    key = jax.random.key(0)
    params = POLICY.init(key)
    params = jax.tree.map(lambda x: x + 0.3 * jax.random.normal(key, x.shape), params)
    obs = jax.random.normal(key, (100, 3))
    here = POLICY.apply(params, obs)
    action = gaussian.sample(key, here)
    advantage = jnp.sin(action[:, 0] + obs[:, 1]) - 0.5 * action[:, 1] ** 2
    advantage = (advantage - advantage.mean()) / advantage.std()
    log_prob = gaussian.log_prob(here, action)
    return params, make_batch(obs, action=action, log_prob=log_prob, advantage=advantage)


def step(params, batch, **changes):
    """The parameters after one step, and its info."""
    update = trpo_update(POLICY, 1, **{**SETTINGS, **changes})
    state = TrainableState(params, update.init(params))
    state, info = jax.jit(update.step)(jax.random.key(0), state, batch)
    return state.params, info


def mean_kl(old, new, batch):
    return float(gaussian.kl(POLICY.apply(old, batch.obs), POLICY.apply(new, batch.obs)).mean())


@pytest.mark.parametrize("max_kl", [1e-3, 0.1])
def test_an_accepted_step_stays_within_max_kl_and_improves(max_kl):
    params, batch = example()
    new, info = step(params, batch, max_kl=max_kl)
    assert info["accepted"] == 1
    assert 0.1 * max_kl < mean_kl(params, new, batch) <= max_kl
    loss = surrogate(POLICY)
    assert_allclose(loss(params, batch)[0] - loss(new, batch)[0], info["improvement"], atol=1e-6)
    assert info["improvement"] > 0


@pytest.mark.parametrize("case", ["no better point", "no gradient"])
def test_a_failed_search_leaves_the_parameters_bit_for_bit(case, monkeypatch):
    params, batch = example()
    start = ravel_pytree(params)[0]

    def nowhere_better(params, batch):
        value, info = surrogate(POLICY)(params, batch)
        worse = jnp.where((ravel_pytree(params)[0] == start).all(), 0, 10)
        return value + jax.lax.stop_gradient(worse), info

    if case == "no better point":
        monkeypatch.setattr(updates, "surrogate", lambda policy: nowhere_better)
    else:
        batch = batch._replace(advantage=jnp.zeros_like(batch.advantage))
    new, info = step(params, batch)
    assert info["accepted"] == info["kl"] == 0
    assert ravel_pytree(new)[0].tobytes() == start.tobytes()


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
    wide = (np.asarray(x, np.float64) for x in (flat, batch.obs, batch.action, batch.advantage))
    flat, obs, action, advantage = wide
    layout = unravel(jnp.arange(len(flat), dtype=jnp.float32))["params"]  # place of each number
    layout = jax.tree.map(lambda x: np.asarray(x).astype(int), layout)
    hidden, out, shared = layout["Torso_0"]["Dense_0"], layout["Dense_0"], layout["log_std"]

    def mean(x):
        features = np.tanh(obs @ x[hidden["kernel"]] + x[hidden["bias"]])
        return features @ x[out["kernel"]] + x[out["bias"]]

    eye = np.eye(len(flat))
    columns = [(mean(flat + 1e-6 * e) - mean(flat - 1e-6 * e)) / 2e-6 for e in eye]
    jacobian = np.stack(columns, -1)  # [B, A, P]
    std = np.exp(flat[shared])
    standard = (action - mean(flat)) / std
    score = np.einsum("ba,bap->bp", standard / std, jacobian)
    score[:, shared] += standard**2 - 1
    gradient = (advantage[:, None] * score).mean(0)
    scaled = jacobian / std[:, None]
    fisher = np.einsum("bap,baq->pq", scaled, scaled) / len(obs)
    fisher[shared, shared] += 2
    direction = scipy.linalg.solve(fisher + damping * eye, gradient, assume_a="pos")
    return direction * np.sqrt(2 * max_kl / (direction @ (fisher + damping * eye) @ direction))


def test_the_step_is_that_of_an_independent_implementation():
    params, batch = example()
    new, info = step(params, batch, max_kl=1e-4, cg_iterations=60)
    assert (info["accepted"], info["halvings"]) == (1, 0)
    ours = np.asarray(ravel_pytree(new)[0]) - np.asarray(ravel_pytree(params)[0], np.float64)
    theirs = independent_step(params, batch, 1e-4, 0.1)
    assert ours @ theirs / np.linalg.norm(ours) / np.linalg.norm(theirs) > 0.999
    assert_allclose(np.linalg.norm(ours), np.linalg.norm(theirs), rtol=0.01)
