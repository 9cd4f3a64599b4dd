"""The surrogate objective, minibatch gradient descent and policy networks."""

import jax
import jax.numpy as jnp
import optax
import pytest
from numpy.testing import assert_allclose

from dgae_jax.learn.critics import TARGETS, quantile_critic
from dgae_jax.learn.networks import SharedCovariance, StateCovariance, network
from dgae_jax.learn.types import TrainableState
from dgae_jax.learn.updates import OPTIMIZERS, linear_schedule, minibatch_update, surrogate
from dgae_jax.maths import gaussian
from tests.helpers import distance
from tests.learn.batches import make_batch

SIZE = 24
POLICY = network(SharedCovariance((8,), 2, 1.0), 3)
PARAMS = POLICY.init(jax.random.key(0))


def gradient(loss, params, batch):
    return jax.grad(loss, has_aux=True)(params, batch)[0]


@pytest.fixture(scope="module")
def batch():
    key = jax.random.key(0)
    obs, advantage = jax.random.normal(key, (SIZE, 3)), jax.random.normal(key, (SIZE,))
    distribution = POLICY.apply(PARAMS, obs)
    action = gaussian.sample(key, distribution)
    log_prob = gaussian.log_prob(distribution, action)
    acted = {"action": action, "log_prob": log_prob, "advantage": advantage}
    return make_batch(obs, target=advantage[:, None], **acted)


@pytest.mark.parametrize("clip_eps", [0.2, jnp.inf])
def test_at_rollout_parameters_the_gradient_is_the_policy_gradient(clip_eps, batch):
    def policy_gradient_loss(params):
        log_prob = gaussian.log_prob(POLICY.apply(params, batch.obs), batch.action)
        return -(log_prob * batch.advantage).mean()

    loss = surrogate(POLICY, clip_eps)
    value, info = loss(PARAMS, batch)  # ρ is exactly 1
    assert value == -batch.advantage.mean()
    assert info["clip_fraction"] == info["kl"] == 0
    assert distance(gradient(loss, PARAMS, batch), jax.grad(policy_gradient_loss)(PARAMS)) < 1e-6


def test_clip_stops_the_gradient_beyond_the_clip_range(batch):
    # every ratio is e > 1.2: positive advantages have no gradient, negative ones have
    moved, loss = batch._replace(log_prob=batch.log_prob - 1), surrogate(POLICY, 0.2)
    up, down = (moved._replace(advantage=jnp.full(SIZE, a)) for a in (1.0, -1.0))
    assert float(optax.global_norm(gradient(loss, PARAMS, up))) == 0
    assert float(optax.global_norm(gradient(loss, PARAMS, down))) > 0.1
    assert_allclose(loss(PARAMS, up)[0], -1.2, rtol=1e-6)
    assert_allclose(loss(PARAMS, down)[0], jnp.e, rtol=1e-5)


@pytest.mark.parametrize(("clip_eps", "log_ratio"), [(0.2, 200.0), (jnp.inf, -200.0)])
def test_a_ratio_that_overflows_is_bounded_without_gradient(clip_eps, log_ratio, batch):
    log_prob, advantage = batch.log_prob.at[5].add(-log_ratio), batch.advantage.at[5].set(-1.0)
    wild = batch._replace(log_prob=log_prob, advantage=advantage)
    advantage = batch.advantage.at[5].set(0)
    without = batch._replace(mask=batch.mask.at[5].set(False), advantage=advantage)
    loss = surrogate(POLICY, clip_eps)
    value, info = loss(PARAMS, wild)
    assert all(jnp.isfinite(x) for x in (value, *info.values()))
    assert distance(gradient(loss, PARAMS, wild), gradient(loss, PARAMS, without)) < 1e-6


def test_a_masked_sample_has_no_weight_in_policy_and_critic(batch):
    critic = quantile_critic(3, hidden=(4,), target=TARGETS["sr-lambda"], quantiles=1, kappa=1.0)
    broken = batch._replace(
        mask=batch.mask.at[5].set(False),
        advantage=batch.advantage.at[5].set(0),
        action=batch.action.at[5].set(0),
        log_prob=batch.log_prob.at[5].set(-1e4),
        target=batch.target.at[5].set(1e9),
    )
    without = jax.tree.map(lambda x: jnp.delete(x, 5, axis=0), batch)
    values = critic.init(jax.random.key(0))
    for loss, params in ((surrogate(POLICY, 0.2), PARAMS), (critic.loss, values)):
        got, want = (jax.jit(jax.grad(loss, has_aux=True))(params, b)[0] for b in (broken, without))
        scaled = jax.tree.map(lambda g: g * SIZE / (SIZE - 1), got)
        assert distance(scaled, want) < 1e-5
    assert surrogate(POLICY)(PARAMS, broken)[1]["kl"] == 0


RATE = {"learning_rate": 1.0, "learning_rate_end": 1.0}


@pytest.mark.parametrize(("epochs", "minibatches"), [(1, 4), (3, 8)])
def test_an_epoch_visits_every_sample_once(epochs, minibatches, batch, monkeypatch):
    monkeypatch.setitem(OPTIMIZERS, "sgd", optax.sgd)

    def loss(params, batch):  # each sample's gradient is 1
        return (params - batch.reward).sum(), {}

    passes = {"epochs": epochs, "minibatches": minibatches, "max_grad_norm": jnp.inf}
    update = minibatch_update(loss, 1, optimizer="sgd", **RATE, **passes)
    params = jnp.zeros(())
    before = TrainableState(params, update.init(params))
    state, info = update.step(jax.random.key(0), before, batch)
    assert_allclose(state.params, -float(SIZE) * epochs)
    assert_allclose(info["gradient_norm"], SIZE / minibatches)


def test_schedules_decay_linearly_to_their_end():
    rate = linear_schedule(0.1, 0.5, 4)
    assert_allclose([rate(i) for i in range(6)], [0.1, 0.0875, 0.075, 0.0625, 0.05, 0.05])
    max_kl = linear_schedule(1.0, 0.0, 20, decay_start=0.8)
    want = [1.0] * 17 + [0.75, 0.5, 0.25, 0.0]
    assert_allclose([max_kl(i) for i in range(21)], want, atol=1e-6)


def test_the_global_norm_of_a_gradient_is_bounded(batch):
    fit = {"optimizer": "adam", "epochs": 1, "minibatches": 1, "max_grad_norm": 1.0}
    update = minibatch_update(lambda p, _: (3 * p["a"] + 4 * p["b"], {}), 1, **fit, **RATE)
    params = {"a": jnp.zeros(()), "b": jnp.zeros(())}
    state, _ = update.step(jax.random.key(0), TrainableState(params, update.init(params)), batch)
    assert_allclose(optax.tree_utils.tree_get(state.opt_state, "mu")["b"], 0.1 * 0.8, rtol=1e-6)


# ---- policy networks ----


@pytest.mark.parametrize("covariance", [SharedCovariance, StateCovariance])
def test_first_actions_are_wide_noise_around_zero(covariance, key):
    policy = network(covariance((16, 16), 2, 0.7), 3)
    mean, log_std = policy.apply(policy.init(key), jax.random.normal(key, (5, 4, 3)))
    assert mean.shape == log_std.shape == (5, 4, 2)
    assert float(jnp.abs(mean).max()) < 0.05
    assert_allclose(jnp.exp(log_std), 0.7, rtol=0.05)
    by_observation = bool((log_std[0] != log_std[1]).any())
    assert by_observation == (covariance is StateCovariance)
