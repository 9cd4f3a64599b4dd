"""TRPO's step against definitions, dense matrices, and an implementation in numpy that shares nothing with ours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

from dgae_jax.learn.networks import SharedCovariance, gaussian_policy
from dgae_jax.learn.types import Batch, TrainableState
from dgae_jax.learn.updates import fisher_product, surrogate, trpo_update, trust_region
from dgae_jax.maths import gaussian
from tests.helpers import distance

POLICY = gaussian_policy(3, 2, hidden=(5,), covariance=SharedCovariance, initial_std=0.7)


def example(seed=0, count=200):
    key = jax.random.key(seed)
    params = POLICY.init(key)
    params = jax.tree.map(lambda x: x + 0.3 * jax.random.normal(key, x.shape), params)
    obs = jax.random.normal(key, (count, 3))
    here = POLICY.apply(params, obs)
    action = gaussian.sample(key, here)
    advantage = jnp.sin(action[:, 0] + obs[:, 1]) - 0.5 * action[:, 1] ** 2
    advantage = (advantage - advantage.mean()) / advantage.std()
    column, valid = advantage[:, None], jnp.ones(count, bool)
    return params, Batch(
        obs,
        action,
        gaussian.log_prob(here, action),
        advantage,
        advantage,
        column,
        advantage,
        advantage,
        obs,
        valid,
    )


SEARCH = {"damping": 0.1, "cg_iterations": 30, "max_backtracks": 10, "fisher_every": 1}


def update(loss=None, radius=0.01, **changes):
    return trust_region(
        POLICY, loss or surrogate(POLICY), radius=lambda steps: radius, **{**SEARCH, **changes}
    )


def move(step, params, batch):
    fit, info = jax.jit(step.step)(
        jax.random.key(0), TrainableState(params, step.init(params)), batch
    )
    return fit.params, info


def divergence(old, new, batch):
    return float(gaussian.kl(POLICY.apply(old, batch.obs), POLICY.apply(new, batch.obs)).mean())


def test_the_fisher_product_is_the_hessian_of_the_divergence():
    params, batch = example()
    flat, unravel = ravel_pytree(params)
    here = POLICY.apply(params, batch.obs)
    hessian = jax.jit(
        jax.hessian(lambda x: gaussian.kl(here, POLICY.apply(unravel(x), batch.obs)).mean())
    )(flat)
    product = fisher_product(POLICY, params, batch.obs, 0.0)
    columns = jax.jit(jax.vmap(lambda v: ravel_pytree(product(unravel(v)))[0]))(jnp.eye(len(flat)))
    assert_allclose(columns, hessian, atol=1e-5)


def test_damping_adds_a_multiple_of_the_vector():
    params, batch = example()
    product, damped = (fisher_product(POLICY, params, batch.obs, d)(params) for d in (0.0, 0.5))
    assert distance(jax.tree.map(lambda f, p: f + 0.5 * p, product, params), damped) < 1e-6


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("radius", [1e-3, 1e-2, 0.1])
def test_an_accepted_step_stays_within_the_radius_and_improves(seed, radius):
    params, batch = example(seed)
    new, info = move(update(radius=radius), params, batch)
    assert info["accepted"] == 1
    assert 0.1 * radius < divergence(params, new, batch) <= radius
    loss = surrogate(POLICY)
    assert_allclose(loss(params, batch)[0] - loss(new, batch)[0], info["improvement"], atol=1e-6)
    assert info["improvement"] > 0


def test_a_search_that_fails_leaves_the_parameters_bit_for_bit():
    params, batch = example()
    start = ravel_pytree(params)[0]

    def nowhere_better(p, batch):
        value, info = surrogate(POLICY)(p, batch)
        return value + jax.lax.stop_gradient(
            jnp.where((ravel_pytree(p)[0] == start).all(), 0, 10)
        ), info

    for failing, data in (
        (update(nowhere_better), batch),
        (update(), batch._replace(advantage=jnp.zeros_like(batch.advantage))),
    ):
        new, info = move(failing, params, data)
        assert info["accepted"] == 0
        assert info["kl"] == 0
        for a, b in zip(jax.tree.leaves(params), jax.tree.leaves(new), strict=True):
            assert a.tobytes() == b.tobytes()


def test_a_step_that_is_too_long_is_halved():
    params, batch = example()
    scaled = batch._replace(
        obs=batch.obs.at[::2].multiply(30)
    )  # the Fisher matrix sees every second sample only
    new, info = move(
        update(fisher_every=2, radius=1.0), params, scaled._replace(obs=jnp.roll(scaled.obs, 1, 0))
    )
    assert info["halvings"] >= 1
    assert divergence(params, new, scaled._replace(obs=jnp.roll(scaled.obs, 1, 0))) <= 1.0


def independent_step(params, batch, radius, damping):
    """The natural gradient step in numpy float64: Jacobians by central differences, dense matrices, no autodiff."""
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
    return direction * np.sqrt(2 * radius / (direction @ (fisher + damping * eye) @ direction))


@pytest.mark.parametrize("seed", range(3))
def test_the_step_is_that_of_an_independent_implementation(seed):
    params, batch = example(seed)
    new, info = move(update(radius=1e-4, cg_iterations=60), params, batch)
    assert info["accepted"] == 1
    assert info["halvings"] == 0
    ours = np.asarray(ravel_pytree(new)[0], np.float64) - np.asarray(
        ravel_pytree(params)[0], np.float64
    )
    theirs = independent_step(params, batch, 1e-4, 0.1)
    assert ours @ theirs / np.linalg.norm(ours) / np.linalg.norm(theirs) > 0.999
    assert_allclose(np.linalg.norm(ours), np.linalg.norm(theirs), rtol=0.01)


def step_of_sb3_contrib(params, batch, radius, damping):
    """TRPO in the convention of sb3-contrib, by dense matrices: the KL divergence is averaged over the action's dimensions too.

    There `kl_divergence(old, new).mean()` is a mean over an array [B, A], because PyTorch's Normal is a distribution of one number.
    """
    flat, unravel = ravel_pytree(params)
    old = POLICY.apply(params, batch.obs)

    def divergence(x):
        new = POLICY.apply(unravel(x), batch.obs)
        p, q = jnp.exp(2 * old.log_std), jnp.exp(2 * new.log_std)
        return (new.log_std - old.log_std + (p + (old.mean - new.mean) ** 2) / (2 * q) - 0.5).mean()

    gradient = jax.grad(lambda x: surrogate(POLICY)(unravel(x), batch)[0])(flat)
    damped = np.asarray(
        jax.jit(jax.hessian(divergence))(flat) + damping * jnp.eye(len(flat)), np.float64
    )
    direction = scipy.linalg.solve(damped, -np.asarray(gradient, np.float64), assume_a="pos")
    return direction * np.sqrt(2 * radius / (direction @ damped @ direction))


@pytest.mark.parametrize("seed", range(3))
def test_sb3_contribs_radius_and_damping_are_ours_over_the_number_of_action_dimensions(seed):
    # (F/A + d) x = g and the radius r there, (F + A·d) y = g and A·r here: y = x/A, and the lengths make up for it
    params, batch = example(seed)
    actions, radius, damping = batch.action.shape[-1], 5e-5, 0.1
    new, info = move(
        update(radius=actions * radius, damping=actions * damping, cg_iterations=60), params, batch
    )
    assert (info["accepted"], info["halvings"]) == (1, 0)
    ours = np.asarray(ravel_pytree(new)[0], np.float64) - np.asarray(
        ravel_pytree(params)[0], np.float64
    )
    theirs = step_of_sb3_contrib(params, batch, radius, damping)
    assert np.linalg.norm(ours - theirs) < 1e-3 * np.linalg.norm(theirs)
    unscaled = step_of_sb3_contrib(params, batch, actions * radius, actions * damping)
    assert np.linalg.norm(ours - unscaled) > 0.1 * np.linalg.norm(theirs)


def test_the_radius_falls_from_step_to_step_in_the_last_fifth_of_a_run():
    params, batch = example()
    rule = trpo_update(POLICY, 20, radius=0.01, learning_rate_end=0.0, **SEARCH)
    fit, moved = TrainableState(params, rule.init(params)), []
    for _ in range(20):  # always from the same policy, that which acted
        fit, info = jax.jit(rule.step)(jax.random.key(0), fit._replace(params=params), batch)
        moved.append(float(info["kl"]))
    assert int(fit.opt_state) == 20
    # a step that is not halved has the divergence radius up to third order, so that the ratios are those of the radii
    assert_allclose(np.array(moved) / moved[0], [1] * 17 + [3 / 4, 2 / 4, 1 / 4], rtol=0.05)
